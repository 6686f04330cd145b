"""Environments of TorchRL as a family: `env=torchrl env.id=…`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import torch
from torchrl.data import Bounded
from torchrl.envs import ActionScaling, ClipTransform, Compose, EnvBase, StepCounter, TransformedEnv
from torchrl.envs.transforms import Transform

from safe_rl.envs.contract import ConstrainedEnv
from safe_rl.envs.errors import ConfigError
from safe_rl.envs.foreign import TORCHRL, complete_foreign
from safe_rl.envs.rng import spread_seed
from safe_rl.envs.torchrl.observed_entries import Observe, choose_entries
from safe_rl.envs.torchrl.step_costs import CostsBesideRewards, StepCosts, dotted, entry_key
from safe_rl.envs.torchrl.torchrl_batches import make_batch

__all__ = ["TorchRLEnv", "make_torchrl"]

_STEP = "episode_step"  # not the name that environments themselves may have for it


class TorchRLEnv(ConstrainedEnv, TransformedEnv):
    """N environments of TorchRL with costs, made by `make_torchrl`.

    Attributes:
        cost_keys: The aggregate `cost`, then one key per kind.
        observation_layout: Columns of every entry that is observed.
        max_episode_steps: The largest number of steps of an episode.
    """

    def __init__(self, base_env: EnvBase, config: Mapping[str, Any]) -> None:
        costs = StepCosts(config["cost_keys"], config["outside"], config["cost"])
        _check_entries(base_env, costs.entries)
        # only a step tells what a function of the user's returns
        names = list(costs(base_env.rand_step(base_env.reset())))
        beside = CostsBesideRewards(costs, names)
        seen = TransformedEnv(base_env, beside.clone())
        entries = choose_entries(seen.observation_spec, config["observe"])
        observe = Observe(entries, config["flatten"], map(dotted, seen.state_spec.keys(True, True)))
        length = StepCounter(max_steps=config["num_steps"], step_count_key=_STEP)
        super().__init__(base_env, Compose(beside, length, *_plain_actions(base_env), observe))
        self.cost_keys = names
        self.observation_layout = observe.layout
        self.max_episode_steps = int(config["num_steps"])


def make_torchrl(
    config: Mapping[str, Any],
    *,
    num_envs: int,
    device: torch.device | str = "cpu",
    seed: int | None = None,
    num_threads: int = 0,
) -> TorchRLEnv:
    """Make environments of a class of TorchRL's, or of the user's.

    Args:
        config: `id` and any other key of conf/env/torchrl.yaml.
        num_envs: Number of environments, N.
        device: Where the TensorDicts live.
        seed: Determines every row; rows of different seeds have nothing in common.
        num_threads: Taken as by any family; these environments do not use it.

    Raises:
        ConfigError: For an unknown key or class, or an environment that algorithms cannot use.
        TargetError: For a class or function whose module was not named by `import=`.

    Examples:
        >>> config = {"id": "PendulumEnv", "num_steps": 200}
        >>> config["outside"] = {"cost_speed": ["thdot", -4, 4]}
        >>> env = make_torchrl(config, num_envs=3, seed=0)
        >>> env.rollout(5)["next", "cost_speed"].shape
        torch.Size([3, 5, 1])
    """
    config = complete_foreign(TORCHRL, config)
    env = TorchRLEnv(make_batch(config, num_envs).to(torch.device(device)), config)
    env.set_seed(int(torch.randint(2**31, ())) if seed is None else spread_seed(seed))
    return env


def _check_entries(env: EnvBase, names: Sequence[str]) -> None:
    """Refuse costs that a step cannot do without: what is a cost is nothing else any more."""
    needed = [env.full_state_spec, env.full_action_spec, env.full_done_spec]
    kept = {"reward", *(key for spec in needed for key in spec.keys(True, True))}
    for name in names:
        if entry_key(name) in kept:
            raise ConfigError(
                f"env.cost_keys: '{name}' is a state, an action, a reward or an end, and stays "
                "one. Make a cost of it by env.outside, or by a function of yours (env.cost)."
            )


def _plain_actions(env: EnvBase) -> Iterator[Transform]:
    """Continuous actions are cut to [-1, 1] and stretched to the bounds; choices stay."""
    spec = env.action_spec
    if not isinstance(spec, Bounded):
        if spec.dtype.is_floating_point and not hasattr(spec.space, "n"):
            raise ConfigError("The algorithms need actions that are bounded, or choices.")
        return
    if spec.dtype.is_floating_point:
        yield ActionScaling()
        yield ClipTransform(in_keys_inv=["action"], low=-1.0, high=1.0)
