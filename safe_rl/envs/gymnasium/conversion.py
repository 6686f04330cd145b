"""Gymnasium's environments as TorchRL environments, with their costs beside the reward."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import gymnasium
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from torch import Tensor
from torchrl.envs import GymWrapper

from safe_rl.envs.foreign import FOREIGN, complete_foreign
from safe_rl.envs.gymnasium.gymnasium_env import (
    CheckedSteps,
    CostReader,
    GymnasiumEnv,
    make_adapted,
)
from safe_rl.envs.keys import ConfigError, Count, check_key, found_costs
from safe_rl.envs.rng import spread_seed
from safe_rl.envs.torchrl.step_entries import dotted
from safe_rl.naming import did_you_mean

MakeEnv = Callable[[], gymnasium.Env]
_Maker = Callable[[Mapping[str, Any]], MakeEnv]
_FAILURES = (AssertionError, NotImplementedError, TypeError, ValueError, gymnasium.error.Error)


def from_gymnasium(
    env: str | Callable[..., gymnasium.Env],
    *,
    num_envs: int = 1,
    cost_keys: Sequence[str] | None = None,
    outside: Mapping[str, Sequence[Any]] | None = None,
    num_steps: int | None = None,
    seed: int | None = None,
    device: torch.device | str = "cpu",
    flatten: bool = True,
    privileged: str | None = None,
    **kwargs: Any,
) -> GymnasiumEnv:
    """Make a TorchRL environment of any Gymnasium environment that reports costs.

    Costs are entries of `info`, or the third of six values of a step, as in Safety-Gymnasium; this
    one is called `cost`, and has to be among `cost_keys` if they are given.

    Every observation becomes one float32 vector. Continuous actions are clipped to [-1, 1] and
    scaled to the environment's bounds. Choices (Discrete, MultiDiscrete) are integers. The N
    environments are stepped one after the other.

    Args:
        env: Gymnasium id, or a function that makes an environment.
        num_envs: Number of environments, N.
        cost_keys: Names of the costs in `info`; None takes one step, and uses the names `cost` and
            `cost_<kind>` that it reports.
        outside: Cost key -> a range; a step that leaves it costs 1. A range is (column of the
            observation, lowest, highest), or (entry, column, lowest, highest) for a dictionary.
        num_steps: The largest number of steps of an episode; None takes it from the
            environment's `spec`.
        seed: Environment k is seeded with this number plus k, by a reset before its first episode;
            None draws one.
        device: Device of the TensorDicts.
        flatten: Whether every observation becomes one vector; False keeps pictures and
            dictionaries.
        privileged: Entry of a dictionary that becomes `privileged` [N, m], which critics may read
            and actors never do.
        kwargs: Arguments of `gymnasium.make`, or of the function.

    Returns:
        An environment [N] with the costs in its reward spec. Without a cost named `cost`, the sum
        of the others gets this name. A copy (`copy.deepcopy`) continues the present episodes if
        copies of the Gymnasium environments do.

    Raises:
        ValueError: If there are no costs, actions are neither continuous and bounded nor choices,
            observations cannot become arrays, or the length of episodes is not known.

    Examples:
        >>> env = from_gymnasium("Safexp-PointGoal1-v0", num_envs=2, num_steps=1000, seed=0)
        >>> env.rollout(3)["next", "cost_hazards"].shape
        torch.Size([2, 3, 1])
    """
    check_key("num_envs", Count, num_envs)
    if num_steps is not None:
        check_key("num_steps", Count, num_steps)
    if isinstance(cost_keys, str):
        raise ConfigError(f"'cost_keys' must be a list of names, such as ['{cost_keys}'].")
    if not (isinstance(env, str) or callable(env)):
        raise ConfigError(
            f"'env' must be an id or a function that makes an environment, got {env}: several are "
            "made, so give its class, or a function such as lambda: MyEnv(…)."
        )
    config = {"cost_keys": cost_keys, "num_steps": num_steps, "outside": outside}
    config |= {"flatten": flatten, "privileged": privileged, "kwargs": kwargs, "render_mode": None}
    node = {"id": env, **config}
    make = _registered(node) if isinstance(env, str) else partial(env, **kwargs)
    config["cost_keys"], config["num_steps"] = _describe(make, config)
    return _batch(make, config, num_envs, seed, device, watch=cost_keys is None)


def _batch(
    make: MakeEnv,
    config: Mapping[str, Any],
    num_envs: int,
    seed: int | None,
    device: torch.device | str,
    *,
    watch: bool = True,
) -> GymnasiumEnv:
    """Make N environments; with `watch`, there is a warning about costs that are not counted."""
    keys, length = [*dict.fromkeys(config["cost_keys"])], config["num_steps"]
    # a dictionary keeps its entries until the privileged one is taken out
    is_vector = config["flatten"] and config["privileged"] is None
    make_one = partial(make_adapted, make, length, is_vector, keys, watch)
    worlds = SyncVectorEnv([make_one] * num_envs, autoreset_mode=AutoresetMode.DISABLED)
    base = _PartlyReset(worlds, device=torch.device(device), categorical_action_encoding=True)
    entries = list(map(dotted, base.observation_spec.keys(True, True)))
    observe = [name for name in entries if name != config["privileged"]]
    base.set_info_dict_reader(CostReader(keys, num_envs, patience=length))
    batch = GymnasiumEnv(base, {**config, "cost_keys": keys, "observe": observe, "cost": None})
    batch.set_seed(int(torch.randint(2**31, ())) if seed is None else seed)
    return batch


class _PartlyReset(GymWrapper):
    """TorchRL's wrapper, whose partial resets need a mask, and one on the CPU."""

    def _replace_reset(self, reset: Tensor | None, kwargs: dict[str, Any]) -> dict[str, Any]:
        return kwargs if reset is None else super()._replace_reset(reset.cpu(), kwargs)


def make_gymnasium(config: Mapping[str, Any], **settings: Any) -> GymnasiumEnv:
    """Make environments of an id that is registered with Gymnasium: `env=gymnasium env.id=…`.

    Args:
        config: `id` and any other key of the family.
        settings: `num_envs`, `device`, `seed` and `num_threads`; the last one is not used. Rows of
            different seeds have independent random draws.

    Raises:
        ConfigError: For an unknown key or id, or an environment that the algorithms cannot use.
    """
    return _make_node("gymnasium", _registered, config, **settings)


def make_safety_gymnasium(config: Mapping[str, Any], **settings: Any) -> GymnasiumEnv:
    """Make environments of an id of `safety_gymnasium.make`; arguments as of `make_gymnasium`.

    Raises:
        ConfigError: As `make_gymnasium`, and if Safety-Gymnasium cannot be imported.
    """
    return _make_node("safety_gymnasium", _of_safety_gymnasium, config, **settings)


def _make_node(
    family: str,
    maker: _Maker,
    config: Mapping[str, Any],
    num_envs: int,
    device: torch.device | str = "cpu",
    seed: int | None = None,
    num_threads: int = 0,
) -> GymnasiumEnv:
    config = complete_foreign(FOREIGN[family], config)
    make = maker(config)
    try:
        return _batch(make, config, num_envs, None if seed is None else spread_seed(seed), device)
    except _FAILURES as error:
        raise ConfigError(f"env.id={config['id']}: {str(error) or repr(error)}") from error


def _describe_node(maker: _Maker, config: Mapping[str, Any]) -> tuple[list[str], int]:
    """Return the cost keys and the length of episodes of a node; None is replaced by a value."""
    make = maker(config)
    try:
        return _describe(make, config)
    except _FAILURES as error:
        raise ConfigError(f"env.id={config['id']}: {str(error) or repr(error)}") from error


def _describe(make: MakeEnv, config: Mapping[str, Any]) -> tuple[list[str], int]:
    keys, length = config["cost_keys"], config["num_steps"]
    if keys is not None and length is not None:  # environments may be slow to make
        return list(keys), length
    probe = make()
    try:
        keys = _find_costs(probe) if keys is None else list(keys)
        if not keys and config["cost_keys"] is None and not config["outside"]:
            raise ValueError(
                f"{probe.unwrapped} reports no costs: its info has no 'cost' or 'cost_<kind>'. If "
                "one has another name, or is not in every info, name it in 'cost_keys'. Leaving a "
                "range can cost, too: env.outside='{cost_position: [0, -0.5, 0.5]}'. Without "
                "constraints use env.cost_keys=[cost] algo=ppo: a missing cost counts as 0."
            )
        task, spec = _task_of(probe), probe.spec
        limits = getattr(task, "num_steps", None), spec and spec.max_episode_steps
        length = length or min(filter(None, limits), default=None)
        if length is None:
            raise ValueError(f"{probe} does not say how long episodes are: give 'num_steps'.")
        return keys, length
    finally:
        probe.close()


def _find_costs(probe: gymnasium.Env) -> list[str]:
    probe.action_space.seed(0)
    probe.reset(seed=0)
    *_, info = CheckedSteps(probe, [], watch=False).step(probe.action_space.sample())
    return found_costs(info)


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
            f"env.id={env_id}: {error} {did_you_mean(env_id, gymnasium.registry)} A module that "
            "registers an environment is imported by import=my_module."
        ) from error
    # the spec, because other processes may not have registered the id
    return partial(gymnasium.make, spec, **_arguments(config))


def _of_safety_gymnasium(config: Mapping[str, Any]) -> MakeEnv:
    """Return a function that makes one environment of a node of `env=safety_gymnasium`."""
    try:
        import safety_gymnasium
    except ImportError as error:
        raise ConfigError(
            f"Safety-Gymnasium cannot be imported in this Python ({error}); its release 1.0 needs "
            "older releases of Gymnasium and MuJoCo than safe_rl. Your own environments with six "
            "values do not need the package: use from_gymnasium."
        ) from error

    def make() -> gymnasium.Env:
        env = safety_gymnasium.make(config["id"], **_arguments(config))
        if config["num_steps"] and (task := _task_of(env)):
            task.num_steps = config["num_steps"]
        return env

    return make


def _task_of(env: gymnasium.Env) -> Any:
    """The task of Safety-Gymnasium, which ends episodes itself; None for other environments."""
    world = env.unwrapped
    is_theirs = type(world).__module__.partition(".")[0] == "safety_gymnasium"
    return getattr(world, "task", None) if is_theirs else None


describe_gymnasium = partial(_describe_node, _registered)
describe_safety_gymnasium = partial(_describe_node, _of_safety_gymnasium)
