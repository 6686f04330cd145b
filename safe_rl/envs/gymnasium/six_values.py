"""Environments whose step returns six values, as those of Safety-Gymnasium: the cost is one."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from gymnasium.wrappers import vector

from safe_rl.envs.costs import COST, is_cost
from safe_rl.envs.errors import ConfigError
from safe_rl.envs.families import SAFETY_GYMNASIUM
from safe_rl.envs.gymnasium import conversion
from safe_rl.envs.gymnasium.conversion import from_gymnasium, make_node
from safe_rl.envs.gymnasium.env_wrappers import COST_SUM, SixValues, plain_actions, stretch
from safe_rl.envs.gymnasium.gymnasium_env import GymnasiumEnv, from_vector

__all__ = ["describe_node", "from_six_values", "make_safety_gymnasium"]


def make_safety_gymnasium(
    config: Mapping[str, Any],
    *,
    num_envs: int,
    device: torch.device | str = "cpu",
    seed: int | None = None,
    num_threads: int = 0,
) -> GymnasiumEnv:
    """Make environments of an id that `safety_gymnasium.make` knows.

    The arguments are those of `make_gymnasium`, with the keys of conf/env/safety_gymnasium.yaml.

    Raises:
        ConfigError: For an unknown key or id, or if the package cannot be imported.

    Examples:
        >>> make_safety_gymnasium({"id": "SafetyPointGoal1-v0", "worker": 2}, num_envs=1)
        Traceback (most recent call last):
        ...
        safe_rl.envs.errors.ConfigError: An environment of Safety-Gymnasium has no key 'worker'. ...
    """
    return make_node(SAFETY_GYMNASIUM, _maker_of_node, config, num_envs, device, seed)


def describe_node(config: Mapping[str, Any]) -> tuple[list[str], int]:
    """Return the cost keys and the length of episodes of a node, found out where they are None."""
    return conversion.describe_node(config, _maker_of_node)


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
        env: A function that makes one environment; or a batch of them, as
            `safety_gymnasium.vector.make` returns it, that starts new episodes by itself.
        num_envs: Number of environments, N; a batch has its own.
        cost_keys: Kinds of costs that are taken from `info` beside the step's own cost; None takes
            all that are called `cost_<kind>`, found by taking a step.
        num_steps: The largest number of steps of an episode; None takes what the environment says,
            which a batch does not.
        seed: Of all environments.
        device: Where the TensorDicts live.

    Returns:
        An environment [N]; `cost` is what a step returns.

    Raises:
        ValueError: If a step has another number of values, or the length of episodes is not known.

    Examples:
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
    kinds = None if cost_keys is None else [key for key in cost_keys if key != COST]
    if not hasattr(env, "single_action_space"):
        return from_gymnasium(
            partial(_six, env),
            num_envs=num_envs or 1,
            cost_keys=None if kinds is None else [COST, *kinds],
            num_steps=num_steps,
            seed=seed,
            device=device,
        )
    batch: Any = env
    if num_envs not in (None, batch.num_envs):
        raise ValueError(f"num_envs={num_envs}: the batch has {batch.num_envs} environments.")
    if num_steps is None:
        raise ValueError("A batch does not say how long its episodes are: give 'num_steps'.")
    if kinds is None:
        batch.reset(seed=0)
        infos = batch.step(batch.action_space.sample())[-1]
        kinds = [key for key in infos if is_cost(key) and key not in (COST, COST_SUM)]
    worlds = _as_networks_take_it(DeferredResets(batch, kinds))
    return from_vector(worlds, [COST, *kinds], num_steps, seed=seed, device=device)


class DeferredResets(VectorEnv):
    """Makes a batch that starts new episodes within a step look as if it waited for a reset.

    A step that ends an episode returns the observation in `info["final_observation"]`; the next
    reset returns the first observation of the episode that has begun already.

    Args:
        env: Its step returns six arrays.
        kinds: Names in `info` of kinds of costs; 0 where it reports none.
    """

    def __init__(self, env: Any, kinds: Sequence[str]) -> None:
        self._batch, self._kinds = env, list(kinds)
        self.num_envs = int(env.num_envs)
        self.single_observation_space = env.single_observation_space
        self.single_action_space = env.single_action_space
        self.observation_space, self.action_space = env.observation_space, env.action_space
        self.render_mode = getattr(env, "render_mode", None)
        given = getattr(env, "metadata", None) or {}
        self.metadata = {**given, "autoreset_mode": AutoresetMode.DISABLED}
        self._begun: np.ndarray | None = None

    def reset(
        self, *, seed: int | Sequence[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start new episodes everywhere; or show those that have begun, by `reset_mask` [N]."""
        others = dict(options or {})
        mask = others.pop("reset_mask", None)
        if mask is None or self._begun is None:
            given = {"options": others} if others else {}
            self._begun = np.array(self._batch.reset(seed=seed, **given)[0])
        return self._begun.copy(), {}

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Take an action [N, A] in every environment."""
        values: tuple[Any, ...] = self._batch.step(actions)
        if len(values) != 6:
            raise ValueError(
                f"A step of {self._batch} returned {len(values)} values instead of six "
                "(observations, rewards, costs, terminated, truncated, infos)."
            )
        begun, rewards, costs, terminated, truncated, infos = values
        self._begun = np.array(begun)
        ends = np.asarray(terminated) | np.asarray(truncated)
        seen, reported = self._begun.copy(), {COST: np.array(costs, np.float64)}
        for key in self._kinds:
            reported[key] = np.asarray(infos.get(key, 0.0), np.float64) * ~ends
        for row in np.flatnonzero(ends):  # whose `info` is that of the reset
            seen[row] = infos["final_observation"][row]
            for key in self._kinds:
                reported[key][row] = infos["final_info"][row].get(key, 0.0)
        return seen, np.array(rewards), np.array(terminated), np.array(truncated), reported

    def render(self) -> tuple[Any, ...] | None:
        """Return a frame of every environment, where they draw."""
        frames = self._batch.render()
        return None if frames is None else tuple(frames)

    def close_extras(self, **kwargs: Any) -> None:
        """Close the batch."""
        self._batch.close()


def _as_networks_take_it(batch: VectorEnv) -> VectorEnv:
    """One float32 vector is observed, and actions are in [-1, 1] or choices."""
    seen, actions = batch.single_observation_space, batch.single_action_space
    if not isinstance(seen, Box):
        raise ValueError(f"A batch has to observe arrays (a Box), not {seen}.")
    number, plain = batch.num_envs, plain_actions(actions, str(batch))
    vectors = Box(-np.inf, np.inf, (int(np.prod(seen.shape)),), np.float32)
    batch = vector.TransformObservation(
        batch, partial(_vectors, number), batch_space(vectors, number), vectors
    )
    if isinstance(actions, Box):
        batch = vector.TransformAction(
            batch, partial(stretch, actions), batch_space(plain, number), plain
        )
    # TorchRL asks for it, and Gymnasium's wrappers do not have it.
    setattr(batch, "autoreset_mode", AutoresetMode.DISABLED)  # noqa: B010
    return batch


def _vectors(number: int, observation: np.ndarray) -> np.ndarray:
    return np.asarray(observation, np.float32).reshape(number, -1)


def _maker_of_node(config: Mapping[str, Any]) -> Callable[[], gymnasium.Env]:
    """Return a function that makes one environment, with its cost in `info`."""
    try:
        import safety_gymnasium
    except ImportError as error:
        raise ConfigError(
            f"Safety-Gymnasium cannot be imported in this Python ({error}). Its release 1.0 wants "
            "an older Gymnasium and MuJoCo than safe_rl; install a release that can be imported "
            "beside it. Environments of yours with six values need no package: from_six_values."
        ) from error
    kwargs = dict(config["kwargs"] or {})
    named = {"render_mode": config["render_mode"], "max_episode_steps": config["num_steps"]}
    kwargs |= {key: value for key, value in named.items() if value is not None}
    return partial(_six, partial(safety_gymnasium.make, config["id"], **kwargs))


def _six(make: Callable[[], gymnasium.Env]) -> gymnasium.Env:
    return SixValues(make())
