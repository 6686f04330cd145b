"""Environments of TorchRL, and of users in its interface, with costs that a rule computes.

The family `env=torchrl env.id=…` makes batches of N of them.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from functools import partial
from operator import methodcaller
from typing import Any

import gymnasium
import torch
import torchrl.envs
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Categorical, OneHot
from torchrl.envs import (
    ActionScaling,
    BatchSizeTransform,
    ClipTransform,
    Compose,
    EnvBase,
    SerialEnv,
    StepCounter,
    TransformedEnv,
)
from torchrl.envs.transforms import Transform

from safe_rl.envs.contract import ConstrainedEnv, bounds_of
from safe_rl.envs.foreign import FOREIGN, complete_foreign
from safe_rl.envs.keys import ConfigError, found_costs
from safe_rl.envs.pictures import load_backend
from safe_rl.envs.rng import spread_seed
from safe_rl.envs.torchrl.step_entries import CompleteSteps, Observe, StepCosts
from safe_rl.naming import did_you_mean
from safe_rl.trust import locate

# These classes use another package by default; MuJoCo's own library is installed.
_MUJOCO = {"backend": "mujoco", "parallel": False}
TORCHRL_CLASSES: dict[str, Mapping[str, Any]] = {
    "PendulumEnv": {},
    "FinancialRegimeEnv": {},
    **dict.fromkeys(("AntEnv", "HumanoidEnv", "Walker2dEnv"), _MUJOCO),
}
"""Classes of `torchrl.envs` that need no `import=`, and their default arguments."""

MakeEnv = partial[EnvBase]
_STEP = "episode_step"  # environments may write TorchRL's default, "step_count", themselves
# Errors of constructors that get wrong arguments or lack a package.
_FAILURES = (ImportError, TypeError, ValueError, LookupError, gymnasium.error.Error)


class TorchRLEnv(ConstrainedEnv, TransformedEnv):
    """N environments of TorchRL with costs, made by `make_torchrl`.

    Args:
        base_env: The environment, [N].
        config: `num_steps`, and the keys of `StepCosts` and `Observe`.
        others: Transforms that come after the costs.

    Attributes:
        cost_keys: The aggregate `cost`, then one key per kind.
        observation_layout: Columns of every observed entry, as if all were one vector.
        max_episode_steps: The largest number of steps of an episode.
    """

    def __init__(self, base_env: EnvBase, config: Mapping[str, Any], *others: Transform) -> None:
        costs = StepCosts(base_env, config)
        observe = Observe(TransformedEnv(base_env, costs.clone()), config)
        super().__init__(base_env, Compose(costs, *others, *_plain_actions(base_env), observe))
        self.cost_keys = costs.names
        self.observation_layout = observe.layout
        self.privileged_layout = observe.privileged_layout
        self.max_episode_steps = int(config["num_steps"])
        _ = self.action_spec  # `ActionScaling` reads it, and cannot be copied before

    @property
    def action_bounds(self) -> tuple[Tensor, Tensor] | None:
        """Bounds of the environment itself, to which actions in [-1, 1] are scaled."""
        return bounds_of(self.base_env.action_spec_unbatched)


def make_torchrl(
    config: Mapping[str, Any],
    *,
    num_envs: int,
    device: torch.device | str = "cpu",
    seed: int | None = None,
    num_threads: int = 0,
) -> TorchRLEnv:
    """Make environments of a class of TorchRL or of the user.

    The arguments are those of `make_gymnasium`, with the keys of `env=torchrl`.

    Raises:
        ConfigError: For an unknown key or class, or an environment that algorithms cannot use.
        TargetError: For a class or function whose module was not named by `import=`.
    """
    config = complete_foreign(FOREIGN["torchrl"], config)
    env = _tried(config, partial(_batch, num_envs=num_envs))
    if not isinstance(env, EnvBase) or list(env.batch_size) != [num_envs]:
        shown = list(env.batch_size) if isinstance(env, EnvBase) else type(env).__name__
        raise ConfigError(
            f"env.id={config['id']} must make an environment [N] or a single one, got {shown}."
        )
    length = StepCounter(max_steps=config["num_steps"], step_count_key=_STEP)
    batch = TorchRLEnv(env.to(torch.device(device)), config, length)
    batch.set_seed(int(torch.randint(2**31, ())) if seed is None else spread_seed(seed))
    return batch


def describe_node(config: Mapping[str, Any]) -> tuple[list[str], int]:
    """Return the cost keys and the length of episodes of a node, read from one environment."""
    env = _tried(config, _one)
    try:
        steps = config["num_steps"] or getattr(env, "max_episode_steps", None)
        if not isinstance(steps, int):
            raise ConfigError(
                f"env.id={config['id']} does not say how long episodes are: give env.num_steps=…"
            )
        entries = (*env.observation_spec.keys(), *env.full_reward_spec.keys())
        cost_keys = found_costs(entries)
        return cost_keys if config["cost_keys"] is None else list(config["cost_keys"]), steps
    finally:
        env.close(raise_if_closed=False)


def _plain_actions(env: EnvBase) -> Iterator[Transform]:
    """Transforms that clip continuous actions to [-1, 1] and scale them to the bounds."""
    spec = env.action_spec
    if isinstance(spec, Bounded) and spec.dtype.is_floating_point:
        width = spec.space.high - spec.space.low
        if not (width.isfinite() & (width > 0)).all():
            raise ConfigError(
                "Every action needs finite bounds, to which [-1, 1] is scaled; they are "
                f"{spec.space.low[0].tolist()} and {spec.space.high[0].tolist()}."
            )
        yield ActionScaling()
        yield ClipTransform(in_keys_inv=["action"], low=-1.0, high=1.0)
        return
    if isinstance(spec, Bounded):  # a MultiDiscrete of several environments
        is_choice = not spec.space.low.any()
    else:
        is_choice = isinstance(spec, Categorical | OneHot) and not isinstance(spec, Binary)
    if not is_choice:
        raise ConfigError(
            "The algorithms need actions that are continuous and bounded (a Box) or choices "
            f"(Discrete, MultiDiscrete), got {type(spec).__name__} {spec.dtype}."
        )


def _tried(config: Mapping[str, Any], make_some: Callable[[MakeEnv], EnvBase]) -> EnvBase:
    """Call `make_some` with the function that makes one environment; failures are ConfigErrors."""
    name, kwargs = config["id"], dict(config["kwargs"] or {})
    if kwargs.get("from_pixels"):
        load_backend()
    if "." in name:
        make: MakeEnv = partial(locate(name, key="env.id"), **kwargs)
    elif name in TORCHRL_CLASSES:
        make = partial(getattr(torchrl.envs, name), **{**TORCHRL_CLASSES[name], **kwargs})
    else:
        raise ConfigError(
            f"env.id={name} is not among {', '.join(TORCHRL_CLASSES)}."
            f"{did_you_mean(name, TORCHRL_CLASSES)} For another class use import=torchrl.envs "
            "env.id=torchrl.envs.NAME, or import=my_module env.id=my_module.NAME."
        )
    try:
        return make_some(make)
    except _FAILURES as error:
        raise ConfigError(f"env.id={name}: {type(error).__name__}: {error}") from error


def _one(make: MakeEnv) -> EnvBase:
    # a metaclass may hide the signature of a class
    builder = make.func.__init__ if inspect.isclass(make.func) else make.func
    return make(num_envs=1) if "num_envs" in inspect.signature(builder).parameters else make()


def _batch(make: MakeEnv, num_envs: int) -> EnvBase:
    """Make N environments.

    A class with the argument `num_envs` makes them itself. A stateless class (`batch_locked` is
    False) is stepped with the states of all rows at once. Any other class is made N times, and the
    environments are stepped one after the other.
    """
    env = _one(make)
    if not env.batch_size and not env.batch_locked:
        rows = Rows(env, num_envs)
        with suppress(Exception):  # of code that cannot begin several rows at once, as promised
            rows.reset()
            return rows
    if list(env.batch_size) == [num_envs]:
        return env
    env.close(raise_if_closed=False)
    if not env.batch_size:
        return SerialEnv(num_envs, partial(_complete, make))
    many = make(num_envs=num_envs)
    if list(many.batch_size) != [num_envs, 1]:
        return many
    # with MuJoCo's own library, TorchRL makes a SerialEnv of environments [1]
    return SerialEnv(num_envs, partial(_alone, make))


class Rows(EnvBase):
    """N rows of a stateless environment (`batch_locked` is False), stepped at once.

    TorchRL's `BatchSizeTransform` cannot be used here: with it, outer transforms cannot change the
    actions.
    """

    def __init__(self, env: EnvBase, num_envs: int) -> None:
        super().__init__(device=env.device, batch_size=[num_envs])
        self.env = env
        self.observation_spec = env.observation_spec.expand(num_envs)
        self.state_spec = env.state_spec.expand(num_envs)
        self.action_spec = env.full_action_spec.expand(num_envs)
        self.reward_spec = env.full_reward_spec.expand(num_envs)
        self.done_spec = env.full_done_spec.expand(num_envs)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        """Reset all rows; TorchRL then restores those that continue."""
        return self.env.reset(TensorDict(batch_size=self.batch_size, device=self.device), **kwargs)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        return self.env.step(tensordict)["next"]

    def _set_seed(self, seed: int | None) -> None:
        self.env.set_seed(seed)


def _complete(make: MakeEnv) -> EnvBase:
    """Make an environment whose steps are checked, as its own transforms have changed them."""
    return TransformedEnv(make(), CompleteSteps(), auto_unwrap=False)


def _alone(make: MakeEnv) -> EnvBase:
    """Make an environment of batch size [1], and squeeze it for `SerialEnv`."""
    return TransformedEnv(_one(make), BatchSizeTransform(reshape_fn=methodcaller("squeeze", 0)))
