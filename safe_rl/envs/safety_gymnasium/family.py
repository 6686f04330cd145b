"""Safety-Gymnasium as a family: `env=safety_gymnasium env.id=…`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import gymnasium
import torch

from safe_rl.envs.costs import COST
from safe_rl.envs.gymnasium.conversion import GymnasiumEnv, from_gymnasium, from_vector
from safe_rl.envs.rng import spread_seed
from safe_rl.envs.safety_gymnasium.nodes import complete_safety_gymnasium
from safe_rl.envs.safety_gymnasium.other_python import ServedVectorEnv
from safe_rl.envs.safety_gymnasium.six_values import SixValues, kinds_of
from safe_rl.envs.safety_gymnasium.sources import make_single, probe_kinds, serve_some
from safe_rl.envs.safety_gymnasium.vectors import DeferredResets, PlainVectorEnv
from safe_rl.envs.safety_gymnasium.where import other_python

__all__ = ["from_six_values", "make_safety_gymnasium"]


def make_safety_gymnasium(
    config: Mapping[str, Any],
    *,
    num_envs: int,
    device: torch.device | str = "cpu",
    seed: int | None = None,
    num_threads: int = 0,
) -> GymnasiumEnv:
    """Make environments of an id of Safety-Gymnasium's.

    Args:
        config: `id` and any other key of `safe_rl.envs.safety_gymnasium.nodes`.
        num_envs: number of environments, N.
        device: where the TensorDicts live.
        seed: determines every row; rows of different seeds have nothing in common.
        num_threads: taken as any family does; these environments have no use for it.

    Raises:
        ConfigError: for an unknown key or id, or if the package is not there.

    Examples:
        >>> make_safety_gymnasium({"id": "SafetyPointGoal1-v0", "worker": 2}, num_envs=1)
        Traceback (most recent call last):
        ...
        safe_rl.envs.errors.ConfigError: An environment of Safety-Gymnasium has no key 'worker'. ...
    """
    config = complete_safety_gymnasium(config)
    python, keys = other_python(), list(config["cost_keys"])
    spread = None if seed is None else spread_seed(seed)
    if python is None:
        return from_gymnasium(
            partial(make_single, config),
            num_envs=num_envs,
            cost_keys=keys,
            num_steps=config["num_steps"],
            seed=spread,
            workers=config["workers"],
            device=device,
        )
    kinds = [key for key in keys if key != COST]
    start = partial(serve_some, config, python)
    worlds = ServedVectorEnv(start, num_envs, max(1, min(config["workers"], num_envs)), kinds)
    worlds.render_mode = config["render_mode"]
    return from_vector(
        PlainVectorEnv(worlds), keys, config["num_steps"], seed=spread, device=device
    )


def from_six_values(
    env: Callable[[], gymnasium.Env] | Any,
    *,
    num_envs: int | None = None,
    cost_keys: Sequence[str] | None = None,
    num_steps: int | None = None,
    seed: int | None = None,
    device: torch.device | str = "cpu",
) -> GymnasiumEnv:
    """Make a TorchRL environment of environments whose step returns six values.

    Args:
        env: a function that makes one environment; or a batch of them, as
            `safety_gymnasium.vector.make` returns it, that starts new episodes by itself.
        num_envs: number of environments, N; a batch has its own.
        cost_keys: kinds of costs that are taken from `info` beside the step's own cost; None takes
            all that are called `cost_<kind>`, found by taking a step.
        num_steps: the largest number of steps of an episode; None takes what the environment says,
            which a batch does not.
        seed: of all environments.
        device: where the TensorDicts live.

    Returns:
        An environment [N]; `cost` is what a step returns.

    Raises:
        ValueError: if a step has another number of values, or the length of episodes is not known.

    Examples:
        >>> import numpy as np
        >>> class Slide(gymnasium.Env):
        ...     observation_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)
        ...     action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)
        ...     def reset(self, seed=None, options=None):
        ...         return np.zeros(1, np.float32), {}
        ...     def step(self, action):
        ...         return action, 1.0, float(action[0] > 0), False, False, {}
        >>> from_six_values(Slide, num_envs=2, num_steps=5).rollout(9)["next", "cost"].shape
        torch.Size([2, 5, 1])
    """
    manner: dict[str, Any] = {"seed": seed, "device": device}
    if not hasattr(env, "single_action_space"):
        make = partial(_six, env)
        keys = probe_kinds(make()) if cost_keys is None else cost_keys
        keys = [COST, *(key for key in keys if key != COST)]
        return from_gymnasium(
            make, num_envs=num_envs or 1, cost_keys=keys, num_steps=num_steps, **manner
        )
    batch: Any = env
    if num_envs not in (None, batch.num_envs):
        raise ValueError(f"num_envs={num_envs}: the batch has {batch.num_envs} environments.")
    if num_steps is None:
        raise ValueError("A batch does not say how long its episodes are: give 'num_steps'.")
    batch.reset(seed=0)
    found = kinds_of(batch.step(batch.action_space.sample())[-1])
    kinds = [key for key in (found if cost_keys is None else cost_keys) if key != COST]
    worlds = PlainVectorEnv(DeferredResets(batch, kinds))
    return from_vector(worlds, [COST, *kinds], num_steps, **manner)


def _six(make: Callable[[], gymnasium.Env]) -> gymnasium.Env:
    return SixValues(make())
