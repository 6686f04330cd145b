"""Run whole episodes of a fixed policy, after training and periodically during training."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type
from tqdm import tqdm

from safe_rl.collectors import check_steps
from safe_rl.naming import STEPS_TAKEN


@dataclass(frozen=True)
class Episodes:
    """Returns, lengths and costs of E whole episodes.

    Attributes:
        returns: Undiscounted returns, shape [E].
        lengths: Steps, shape [E].
        costs: Cost key -> undiscounted costs, shape [E].
    """

    returns: Tensor
    lengths: Tensor
    costs: dict[str, Tensor]


def exploration(deterministic: bool) -> set_exploration_type:
    """Context in which policies act with their mean, or sample."""
    kind = ExplorationType.DETERMINISTIC if deterministic else ExplorationType.RANDOM
    return set_exploration_type(kind)


@torch.no_grad()
def collect_episodes(
    env: EnvBase,
    policy: Callable[..., TensorDictBase],
    num_episodes: int,
    cost_keys: Sequence[str],
    *,
    deterministic: bool,
    progress: bool = False,
    record: Callable[[TensorDictBase], None] | None = None,
) -> Episodes:
    """Run a policy for exactly ``num_episodes`` episodes.

    The number of episodes of each world (one of the N environments) is fixed before the first step.
    Taking the episodes that end first would favour short ones.

    Args:
        env: Batched environment, batch_size [N].
        policy: Writes the action into the TensorDict of a state.
        num_episodes: Number of episodes E. Worlds that have finished their share continue until all
            have, but their further episodes do not count.
        cost_keys: Keys of the costs to sum, below "next".
        deterministic: Whether the policy acts with its mean.
        progress: Whether to show a bar.
        record: Function that gets every step [N], including those that do not count.

    Raises:
        FloatingPointError: If a reward or a cost is NaN or infinite.
        EpisodeError: If a cost is below 0.

    Examples:
        >>> from safe_rl.envs import make_env
        >>> from safe_rl.models import BehaviourPolicy, make_actor
        >>> env = make_env({"robot_base": "point", "num_steps": 5}, num_envs=2, seed=0)
        >>> size = env.observation_spec["observation"].shape[-1]
        >>> policy = BehaviourPolicy(make_actor(size, 2, hidden_sizes=[8], initial_log_std=-0.5))
        >>> collect_episodes(env, policy, 3, env.cost_keys, deterministic=True).lengths
        tensor([5., 5., 5.], dtype=torch.float64)
    """
    num_envs, return_key = env.batch_size.numel(), env.return_key
    quota = num_episodes // num_envs + (torch.arange(num_envs) < num_episodes % num_envs).long()
    finished = torch.zeros(num_envs, dtype=torch.long)
    # float64: sums of indicator costs are exact
    sums = torch.zeros(num_envs, 2 + len(cost_keys), dtype=torch.float64)
    lowest = torch.zeros(num_envs, 1 + len(cost_keys), dtype=torch.float64)
    rows: list[tuple[Tensor, Tensor]] = []  # world numbers [e], sums of their episodes [e, m]
    state = env.reset()
    with (
        exploration(deterministic),
        tqdm(total=num_episodes, disable=None if progress else True) as bar,
    ):
        while (finished < quota).any():
            step, state = env.step_and_maybe_reset(policy(state))
            if record is not None:
                record(step)
            after = step["next"]
            is_repeating = env.steps_per_decision != 1
            taken = after[STEPS_TAKEN] if is_repeating else torch.ones_like(after[return_key])
            signals = [after["done"], taken, after[return_key]]
            signals += [after[key] for key in cost_keys]
            # one copy for all of them, because every copy waits for the device
            read = torch.cat(signals, -1).to(sums)
            done = read[:, 0].bool()
            sums += read[:, 1:]
            # of single steps: the sum of an episode can hide one below 0
            lowest = torch.minimum(lowest, read[:, 2:])
            if done.any():
                steps = torch.where(sums[:, 1:].isfinite(), lowest, sums[:, 1:])
                columns = zip((return_key, *cost_keys), steps.split(1, -1), strict=True)
                check_steps(dict(columns), cost_keys)
                counts = done & (finished < quota)
                rows.append((counts.nonzero().squeeze(-1), sums[counts]))
                finished += counts
                sums[done] = 0.0
                bar.update(int(counts.sum()))
    # sorted by world, so that the order does not depend on which episode happened to end first
    order = torch.cat([worlds for worlds, _ in rows]).argsort(stable=True)
    lengths, returns, *costs = torch.cat([ended for _, ended in rows])[order].unbind(-1)
    return Episodes(returns, lengths, dict(zip(cost_keys, costs, strict=True)))


# far larger than what a user would add to a run's seed for further runs
_OFFSET = 1_000_000_007


# defaults of keys, also for environments without layouts: every episode is new
_UNLIMITED = {"randomize_layout": True, "layout_seeds": None, "layout_seeds_first": 0}


def has_fixed_layout(env: Mapping[str, Any]) -> bool:
    """Whether all episodes have one layout, which is drawn from the seed."""
    return not (_UNLIMITED | {**env})["randomize_layout"]


def default_seed(env: Mapping[str, Any], training_seed: int) -> int:
    """Seed of an evaluation: not the one of training, so that layouts and noise are new.

    A fixed layout is drawn from the seed, and the policy has learned on this layout only. With such
    a layout, the seed is that of training.
    """
    return training_seed + (0 if has_fixed_layout(env) else _OFFSET)


def shared_layouts(
    trained: Mapping[str, Any], evaluated: Mapping[str, Any], *, same_seed: bool
) -> float:
    """Share of the evaluation's layouts that training could have used, in [0, 1].

    Examples:
        >>> finite = {"randomize_layout": True, "layout_seeds": 10, "layout_seeds_first": 0}
        >>> shared_layouts(finite, {**finite, "layout_seeds_first": 8}, same_seed=False)
        0.2
        >>> shared_layouts(finite, {**finite, "layout_seeds": None}, same_seed=False)
        0.0
    """
    envs = [_UNLIMITED | {**env} for env in (trained, evaluated)]
    sizes = [env["layout_seeds"] if env["randomize_layout"] else None for env in envs]
    if None in sizes:
        randomised = {env["randomize_layout"] for env in envs}
        return float(sizes[0] is sizes[1] and len(randomised) == 1 and same_seed)
    ranges = [
        range(env["layout_seeds_first"], env["layout_seeds_first"] + size)
        for env, size in zip(envs, sizes, strict=True)
    ]
    common = min(r.stop for r in ranges) - max(r.start for r in ranges)
    return max(0, common) / len(ranges[1])


# largest number of worlds that are stepped together
_MOST_WORLDS = 50


def periodic_evaluation(
    make_env: Callable[..., EnvBase],
    policy: TensorDictModuleBase,
    cost_keys: Sequence[str],
    *,
    interval: int,
    episodes: int,
    seed: int,
    fixed_layout: bool,
) -> Callable[[int, int], dict[str, float]]:
    """A function that runs whole episodes of the policy, without exploration, at regular intervals.

    It takes the numbers of steps before and after an epoch, and returns means over episodes if an
    evaluation is due between them, else NaN: one is due every ``interval`` steps. The worlds of an
    evaluation depend only on the seed and the number of steps (a fixed layout only on the seed). So
    an evaluation does not change the random draws of training, and does not depend on
    interruptions.
    """
    names = [f"evaluation_{name}" for name in ("return", *cost_keys)]

    def evaluate(before: int, after: int) -> dict[str, float]:
        if before // interval == after // interval:
            return dict.fromkeys(names, math.nan)
        fresh = (seed + after) % 2**62
        devices = {parameter.device for parameter in policy.parameters() if parameter.is_cuda}
        # new environments every time, because some keep a part of their state after a new seed
        worlds = min(episodes, _MOST_WORLDS)
        with (
            # before environments are made and seeded, which may draw from torch's generator
            torch.random.fork_rng(devices=devices),
            closing(make_env(num_envs=worlds, seed=seed if fixed_layout else fresh)) as env,
        ):
            torch.manual_seed(fresh)
            collected = collect_episodes(env, policy, episodes, cost_keys, deterministic=True)
        means = (values.mean().item() for values in (collected.returns, *collected.costs.values()))
        return dict(zip(names, means, strict=True))

    return evaluate
