"""Evaluation during training: deterministic actions, on layouts that training does not see."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import closing

import torch
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from safe_rl.evaluation.episodes import collect_episodes

__all__ = ["PeriodicEvaluation"]

# worlds that are stepped together at most
_MOST_WORLDS = 50


class PeriodicEvaluation:
    """Runs whole episodes of the policy, without exploration, every so many steps.

    The worlds of an evaluation are drawn from the seed and the number of steps alone: it neither
    changes what training draws nor depends on whether the run was interrupted.

    Args:
        make_env: ``make_env(num_envs=, seed=)`` makes environments like the run's.
        policy: What acts; it shares the parameters that are trained.
        cost_keys: Keys of the costs to sum.
        interval: Steps of training from one evaluation to the next.
        episodes: Episodes of each.
        seed: Of the worlds, to which the steps of training are added, and of what the policy draws.
        fixed_layout: Whether all worlds have one layout, drawn from ``seed`` alone.

    Examples:
        >>> from safe_rl.envs import make_env
        >>> from safe_rl.models import BehaviourPolicy, make_actor
        >>> def make(**keys):
        ...     return make_env({"robot_base": "point", "num_steps": 5}, **keys)
        >>> size = make(num_envs=1, seed=0).observation_spec["observation"].shape[-1]
        >>> policy = BehaviourPolicy(make_actor(size, 2, hidden_sizes=[8], initial_log_std=-0.5))
        >>> evaluate = PeriodicEvaluation(
        ...     make, policy, ["cost"], interval=100, episodes=2, seed=1, fixed_layout=False
        ... )
        >>> evaluate(50, 90)
        {'evaluation_return': nan, 'evaluation_cost': nan}
        >>> evaluate(90, 130)["evaluation_cost"]
        0.0
    """

    def __init__(
        self,
        make_env: Callable[..., EnvBase],
        policy: TensorDictModuleBase,
        cost_keys: Sequence[str],
        *,
        interval: int,
        episodes: int,
        seed: int,
        fixed_layout: bool,
    ) -> None:
        self._make_env, self._policy, self._cost_keys = make_env, policy, list(cost_keys)
        self._interval, self._episodes, self._seed = interval, episodes, seed
        self._fixed_layout = fixed_layout

    def __call__(self, before: int, after: int) -> dict[str, float]:
        """Means over episodes, if one is due between two numbers of steps; otherwise NaN."""
        names = ["return", *self._cost_keys]
        if before // self._interval == after // self._interval:
            return {f"evaluation_{name}": math.nan for name in names}
        # new ones every time: not all environments forget what was before a new seed
        worlds = min(self._episodes, _MOST_WORLDS)
        fresh = (self._seed + after) % 2**62
        seed = self._seed if self._fixed_layout else fresh
        devices = {parameter.device for parameter in self._policy.parameters() if parameter.is_cuda}
        with (
            # first: environments that are made, and seeded, may draw from torch's generator
            torch.random.fork_rng(devices=devices),
            closing(self._make_env(num_envs=worlds, seed=seed)) as env,
        ):
            torch.manual_seed(fresh)
            found = collect_episodes(
                env, self._policy, self._episodes, self._cost_keys, deterministic=True
            )
        values = [found.returns, *(found.costs[key] for key in self._cost_keys)]
        return {
            f"evaluation_{name}": value.mean().item()
            for name, value in zip(names, values, strict=True)
        }
