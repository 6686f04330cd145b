"""What the pages of off-policy algorithms have of their own: settings, and a loop."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

from omegaconf import DictConfig, OmegaConf

from safe_rl.cli.schema import KEYS
from safe_rl.parameters import accepted_names
from safe_rl.trust import locate

NODES = ("memory",)
# what is not a part; the first four are what such an algorithm brings along for the preset
_SHOWN = ("frames", "num_envs", "frames_per_batch", "model.hidden_sizes")
_SECTIONS = ("critics", "exploration", "dataset")
_SIZES = "hidden_sizes=[64, 64]"


def is_off_policy(config: DictConfig) -> bool:
    """Whether a configuration is that of an off-policy algorithm."""
    return OmegaConf.select(config, "algo._target_") == "safe_rl.algorithms.OffPolicy"


def settings(config: DictConfig) -> Iterator[tuple[str, Any, str]]:
    """Path, value and meaning of keys that belong to no part."""
    paths = [*_SHOWN, *(f"{name}.{key}" for name in _SECTIONS for key in config.get(name, {}))]
    for path in paths:
        yield path, OmegaConf.select(config, path), KEYS[path].meaning


def loop(
    config: DictConfig,
    parts: Mapping[str, tuple[str, dict[str, Any]]],
    call: Callable[..., str],
    line: str,
) -> str:
    """A loop of one's own with TorchRL's replay buffer.

    Args:
        config: Configuration of the algorithm.
        parts: Target and arguments of its loss, and of its multiplier if it has one.
        call: Writes a call.
        line: What is to be said before the loop besides, or nothing.
    """
    loss, arguments = parts["loss"]
    names = accepted_names(locate(loss))
    actor = config.actor._target_.rpartition(".")[2]
    targets, own = {loss}, []
    first = ["actor"]
    if "qvalue_network" in names:
        own.append(f"critic = QEnsemble(3, 2, {_SIZES}, num_networks={config.critics.rewards})")
        first.append("critic")
    if "cost_qvalue_network" in names:
        own += [
            f"cost_critic = QEnsemble(3, 2, {_SIZES}, num_networks={config.critics.costs}, "
            'out_key="costs")',
            f"multiplier = {call(*parts['lagrangian'], ('limits',))}",
        ]
        first += ["cost_critic", "multiplier=multiplier", "cost_keys=list(limits)"]
        targets.add(parts["lagrangian"][0])
    if "action_spec" in names:
        first.append("action_spec=Bounded(-1, 1, [2])")
    own.append(f"loss = {call(loss, arguments, tuple(first))}")
    tau, lr = config.policy_update.tau, config.policy_update.optimizer.lr
    return _LOOP.format(
        bounded="Bounded, " if "action_spec" in names else "",
        soft_update="" if tau is None else "\nfrom torchrl.objectives import SoftUpdate",
        imports=_imports({*targets, config.actor._target_}, is_cloning=tau is None),
        limits='limits = {"cost": 25.0}\n' if "multiplier=multiplier" in first else "",
        actor=f"{actor}(3, -torch.ones(2), torch.ones(2), {_SIZES})",
        own="\n".join([*own, *filter(None, [line])]),
        targets="" if tau is None else f"targets = SoftUpdate(loss, tau={tau})\n",
        lr=lr,
        given=", mean_costs" if "multiplier=multiplier" in first else "",
        moved="    # undiscounted, of the episodes that ended\n"
        "    multiplier.update(mean_costs - multiplier.limits)\n"
        if "multiplier=multiplier" in first
        else "",
        follow="" if tau is None else "\n        targets.step()",
        costs=", torch.tensor([30.0])" if "multiplier=multiplier" in first else "",
    )


def _imports(targets: set[str], is_cloning: bool) -> str:
    rooms: dict[str, set[str]] = {"safe_rl.models": set() if is_cloning else {"QEnsemble"}}
    for target in targets:
        room, _, name = target.rpartition(".")
        rooms.setdefault(room, set()).add(name)
    return "\n".join(
        f"from {room} import {', '.join(sorted(rooms[room]))}" for room in sorted(rooms)
    )


_LOOP = """{imports}

import torch
from tensordict import TensorDict
from torchrl.data import {bounded}LazyTensorStorage, TensorDictReplayBuffer{soft_update}

{limits}actor = {actor}
{own}
{targets}optimizer = torch.optim.Adam(loss.parameters(), lr={lr})
buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(10_000), batch_size=64)


def learn(steps{given}, updates=10):
    buffer.extend(steps)
{moved}    for _ in range(updates):
        losses = loss(buffer.sample())
        optimizer.zero_grad()
        sum(value for key, value in losses.items() if key.startswith("loss_")).backward()
        optimizer.step(){follow}
    return losses


flags = torch.zeros(500, 1, dtype=torch.bool)
after = {{"observation": torch.randn(500, 3), "done": flags, "terminated": flags}}
after |= {{"reward": torch.randn(500, 1), "cost": torch.rand(500, 1)}}
steps = TensorDict(
    observation=torch.randn(500, 3), action=torch.rand(500, 2), next=after, batch_size=[500]
)  # a collector's batch, or a dataset
assert learn(steps{costs})["loss_actor"].isfinite()"""
