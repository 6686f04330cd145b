"""Gymnasium's environments in TorchRL, with their costs where the algorithms look for them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from inspect import signature
from typing import Any

import gymnasium
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from torchrl.envs import GymWrapper

from safe_rl.envs.costs import COST, is_cost
from safe_rl.envs.errors import ConfigError, nearest, require_integer
from safe_rl.envs.families import GYMNASIUM, SAFETY_GYMNASIUM, ForeignFamily, complete_foreign
from safe_rl.envs.gymnasium.env_wrappers import SixValues, make_adapted
from safe_rl.envs.gymnasium.gymnasium_env import CostReader, GymnasiumEnv
from safe_rl.envs.rng import spread_seed
from safe_rl.envs.torchrl.step_entries import dotted

__all__ = ["from_gymnasium", "from_six_values", "make_gymnasium", "make_safety_gymnasium"]

MakeEnv = Callable[[], gymnasium.Env]
_FAILURES = (
    *(AssertionError, NotImplementedError, TypeError, ValueError),
    gymnasium.error.Error,
)


def from_gymnasium(
    env: str | MakeEnv,
    *,
    num_envs: int = 1,
    cost_keys: Sequence[str] | None = None,
    outside: Mapping[str, Sequence[Any]] | None = None,
    num_steps: int | None = None,
    seed: int | None = None,
    device: torch.device | str = "cpu",
    flatten: bool = True,
    **kwargs: Any,
) -> GymnasiumEnv:
    """Make a TorchRL environment of any Gymnasium environment that reports costs in `info`.

    Observations become one float32 vector each, continuous actions are clipped to [-1, 1] and
    stretched to the environment's bounds, so that the algorithms can be used as they are. Choices
    (Discrete, MultiDiscrete) are integers. The N environments are stepped one after the other.

    Args:
        env: Gymnasium id, or a function that makes an environment.
        num_envs: Number of environments, N.
        cost_keys: Names of the costs in `info`; None finds those called `cost` or `cost_<kind>` by
            taking one step.
        outside: Cost key -> a range that costs 1 to leave: (column of the observation, lowest,
            highest), or of a dictionary (entry, column, lowest, highest).
        num_steps: The largest number of steps of an episode; None takes what the id says.
        seed: Of all environments; row k has this one plus k.
        device: Where the TensorDicts live.
        flatten: Make one vector of every observation; False leaves pictures and dictionaries as
            they are.
        kwargs: For `gymnasium.make`, with an id.

    Returns:
        An environment [N], with the costs in its reward spec; `cost` is the sum of the others if
        there is none of that name. A copy (`copy`, `pickle`) continues where it was if copies of
        the environments inside do.

    Raises:
        ValueError: If there are no costs, actions are neither continuous and bounded nor choices,
            observations are no arrays, or the length of episodes is not known.

    Examples:
        >>> env = from_gymnasium("Safexp-PointGoal1-v0", num_envs=2, num_steps=1000, seed=0)
        >>> env.rollout(3)["next", "cost_hazards"].shape
        torch.Size([2, 3, 1])
    """
    require_integer("num_envs", num_envs, lowest=1)
    make = _maker(env, kwargs, num_steps)
    keys, length = _describe(make, cost_keys, num_steps, outside)
    make_one = partial(make_adapted, make, length, flatten, keys)
    worlds = SyncVectorEnv([make_one] * num_envs, autoreset_mode=AutoresetMode.DISABLED)
    worlds.env_fns = ()  # not needed again, and custom functions might not be pickled
    base = GymWrapper(worlds, device=torch.device(device), categorical_action_encoding=True)
    observed = list(map(dotted, base.observation_spec.keys(True, True)))
    base.set_info_dict_reader(CostReader(keys, num_envs, patience=length))
    config = {"cost_keys": keys, "outside": outside, "observe": observed, "flatten": flatten}
    batch = GymnasiumEnv(base, {**config, "cost": None, "num_steps": length})
    batch.set_seed(int(torch.randint(2**31, ())) if seed is None else seed)
    return batch


def from_six_values(
    env: MakeEnv, *, cost_keys: Sequence[str] | None = None, **settings: Any
) -> GymnasiumEnv:
    """Make a TorchRL environment of environments whose step returns six values.

    Args:
        env: A function that makes one environment, as Safety-Gymnasium's interface has them.
        cost_keys: Kinds of costs that are taken from `info` beside the step's own cost; None takes
            all that are called `cost_<kind>`, found by taking a step.
        settings: Any other argument of `from_gymnasium`.

    Returns:
        An environment [N]; `cost` is what a step returns.

    Raises:
        ValueError: If a step has another number of values, or the length of episodes is not known.

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
    if not callable(env):
        raise ConfigError(
            f"Give a function that makes one environment; num_envs=… makes several. Got {env!r}."
        )
    keys = None if cost_keys is None else [COST, *(key for key in cost_keys if key != COST)]
    return from_gymnasium(partial(_six_values, env), cost_keys=keys, **settings)


def make_gymnasium(config: Mapping[str, Any], **settings: Any) -> GymnasiumEnv:
    """Make environments of an id that is registered with Gymnasium: `env=gymnasium env.id=…`.

    Args:
        config: `id` and any other key of conf/env/gymnasium.yaml.
        settings: `num_envs`, `device`, `seed` and `num_threads`; the last one is not used. Rows of
            different seeds have nothing in common.

    Raises:
        ConfigError: For an unknown key or id, or an environment that the algorithms cannot use.
    """
    return _make_node(GYMNASIUM, _registered, config, **settings)


def make_safety_gymnasium(config: Mapping[str, Any], **settings: Any) -> GymnasiumEnv:
    """Make environments of an id that `safety_gymnasium.make` knows, as `make_gymnasium`.

    Raises:
        ConfigError: As there, and if the package cannot be imported.
    """
    return _make_node(SAFETY_GYMNASIUM, _of_safety_gymnasium, config, **settings)


def _make_node(
    family: ForeignFamily,
    maker: Callable[[Mapping[str, Any]], MakeEnv],
    config: Mapping[str, Any],
    num_envs: int,
    device: torch.device | str = "cpu",
    seed: int | None = None,
    num_threads: int = 0,
) -> GymnasiumEnv:
    config = complete_foreign(family, config)
    make = maker(config)
    try:
        return from_gymnasium(
            make,
            num_envs=num_envs,
            cost_keys=config["cost_keys"],
            outside=config.get("outside"),
            num_steps=config["num_steps"],
            seed=None if seed is None else spread_seed(seed),
            flatten=config.get("flatten", True),
            device=device,
        )
    except _FAILURES as error:
        raise ConfigError(f"env.id={config['id']}: {error}") from error


def _describe_node(
    maker: Callable[[Mapping[str, Any]], MakeEnv], config: Mapping[str, Any]
) -> tuple[list[str], int]:
    """Cost keys and length of episodes of a node, found out where they are None."""
    make, outside = maker(config), config.get("outside")
    try:
        return _describe(make, config["cost_keys"], config["num_steps"], outside)
    except _FAILURES as error:
        raise ConfigError(f"env.id={config['id']}: {error}") from error


def _describe(
    make: MakeEnv, cost_keys: Sequence[str] | None, num_steps: int | None, outside: Any
) -> tuple[list[str], int]:
    if num_steps is not None:
        require_integer("num_steps", num_steps, lowest=1)
    probe = make()
    if not isinstance(probe, gymnasium.Env):
        raise ConfigError(f"It makes no environment of Gymnasium (gymnasium.Env), but {probe!r}.")
    try:
        keys = _find_costs(probe) if cost_keys is None else [*dict.fromkeys(cost_keys)]
        if cost_keys is None and not keys and not outside:
            raise ValueError(
                f"{probe.unwrapped} reports no costs: there is no 'cost' or 'cost_<kind>' in its "
                "info. If a cost is called otherwise, or is not reported at every step, name it "
                "in 'cost_keys'; 'outside' makes a cost of leaving a range: "
                "env.outside='{cost_position: [0, -0.5, 0.5]}'."
            )
        known = None if probe.spec is None else probe.spec.max_episode_steps
        length = known if num_steps is None else num_steps
        if length is None:
            raise ValueError(f"{probe} does not say how long episodes are: give 'num_steps'.")
        return keys, length
    finally:
        probe.close()


def _maker(env: Any, kwargs: Mapping[str, Any], num_steps: int | None) -> MakeEnv:
    if isinstance(env, str):
        length = {} if num_steps is None else {"max_episode_steps": num_steps}
        # what is registered here goes with it to other processes
        return partial(gymnasium.make, gymnasium.registry.get(env, env), **{**length, **kwargs})
    if isinstance(env, gymnasium.Env) or not callable(env):
        raise ConfigError(f"Give an id, or a function that makes an environment; got {env!r}.")
    for key in kwargs:
        hint = nearest(key, signature(from_gymnasium).parameters)
        raise ConfigError(f"'{key}' is for gymnasium.make, and a function makes these.{hint}")
    return env


def _find_costs(probe: gymnasium.Env) -> list[str]:
    probe.action_space.seed(0)
    probe.reset(seed=0)
    *_, info = probe.step(probe.action_space.sample())
    return [key for key in info if is_cost(key)]


def _arguments(config: Mapping[str, Any]) -> dict[str, Any]:
    named = {"render_mode": config["render_mode"], "max_episode_steps": config["num_steps"]}
    given = {key: value for key, value in named.items() if value is not None}
    return {**given, **(config["kwargs"] or {})}


def _registered(config: Mapping[str, Any]) -> MakeEnv:
    """Return a function that makes one environment of a node of `env=gymnasium`."""
    env_id = config["id"]
    try:
        spec = gymnasium.spec(env_id)
    except gymnasium.error.Error as error:
        raise ConfigError(
            f"env.id={env_id}: {error} {nearest(env_id, gymnasium.registry)} A module that "
            "registers an environment is imported by import=my_module."
        ) from error
    return partial(gymnasium.make, spec, **_arguments(config))


def _of_safety_gymnasium(config: Mapping[str, Any]) -> MakeEnv:
    """Return a function that makes one environment of a node of `env=safety_gymnasium`."""
    try:
        import safety_gymnasium
    except ImportError as error:
        raise ConfigError(
            f"Safety-Gymnasium cannot be imported in this Python ({error}). Its release 1.0 wants "
            "an older Gymnasium and MuJoCo than safe_rl; install a release that can be imported "
            "beside it. Environments of yours with six values need no package: from_six_values."
        ) from error
    make = partial(safety_gymnasium.make, config["id"], **_arguments(config))
    return partial(_six_values, make)


def _six_values(make: MakeEnv) -> gymnasium.Env:
    return SixValues(make())


describe_gymnasium = partial(_describe_node, _registered)
describe_safety_gymnasium = partial(_describe_node, _of_safety_gymnasium)
