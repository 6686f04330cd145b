"""Environments of TorchRL as a family: `env=torchrl env.id=…`, N of them stepped together."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from operator import methodcaller
from typing import Any

import gymnasium
import torch
import torchrl.envs
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Bounded
from torchrl.envs import (
    ActionScaling,
    BatchSizeTransform,
    ClipTransform,
    Compose,
    EnvBase,
    GymLikeEnv,
    SerialEnv,
    StepCounter,
    TransformedEnv,
)
from torchrl.envs.transforms import Transform

from safe_rl.envs.contract import ConstrainedEnv
from safe_rl.envs.costs import is_cost
from safe_rl.envs.errors import ConfigError
from safe_rl.envs.families import TORCHRL, TORCHRL_CLASSES, complete_foreign
from safe_rl.envs.gymnasium.gymnasium_env import CostReader
from safe_rl.envs.opengl import load_backend
from safe_rl.envs.rng import spread_seed
from safe_rl.envs.torchrl.observed_entries import Observe, choose_entries
from safe_rl.envs.torchrl.step_costs import CostsBesideRewards, StepCosts, dotted, entry_key
from safe_rl.targets import locate

__all__ = ["Rows", "TorchRLEnv", "describe_node", "make_batch", "make_torchrl"]

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


MakeEnv = Callable[..., EnvBase]
# Of constructors that cannot do with their arguments, or lack a package.
_FAILURES = (ImportError, TypeError, ValueError, LookupError, gymnasium.error.Error)


class Rows(EnvBase):
    """N copies of an environment without a state of its own, stepped at once.

    TorchRL's `BatchSizeTransform` would start all of them at the same state.

    Args:
        env: Its step is a function of the TensorDict, of any batch size (`batch_locked` is False).
        num_envs: N.

    Examples:
        >>> from torchrl.envs import PendulumEnv
        >>> Rows(PendulumEnv(), 3).rollout(2)["th"].shape
        torch.Size([3, 2])
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
        """Start all rows; TorchRL puts those that go on back in their places."""
        return self.env.reset(TensorDict(batch_size=self.batch_size, device=self.device), **kwargs)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        return self.env.step(tensordict)["next"]

    def _set_seed(self, seed: int | None) -> None:
        self.env.set_seed(seed)


def make_batch(config: Mapping[str, Any], num_envs: int) -> EnvBase:
    """Make N environments, by whatever way their class has to be many.

    A class that takes `num_envs` is asked for that many. One without a state of its own is stepped
    with the states of all rows at once, and of others there are N, stepped one after the other.

    Args:
        config: A whole node.
        num_envs: N.

    Raises:
        ConfigError: If the class cannot be made, or makes another number of them.
        TargetError: If configurations may not name it.

    Examples:
        >>> node = {"id": "PendulumEnv", "kwargs": None, "cost_keys": None, "num_steps": 200}
        >>> make_batch(node, 3).batch_size
        torch.Size([3])
    """
    env = _tried(config, partial(_batch, num_envs=num_envs))
    if not isinstance(env, EnvBase) or list(env.batch_size) != [num_envs]:
        shown = list(env.batch_size) if isinstance(env, EnvBase) else type(env).__name__
        raise ConfigError(
            f"env.id={config['id']}: it must make an environment [N] or a single one, got {shown}."
        )
    return env


def describe_node(config: Mapping[str, Any]) -> tuple[list[str], int]:
    """Return the cost keys and the length of episodes of a node, found out where they are None.

    Raises:
        ConfigError: If the environment does not tell.
    """
    env = _tried(config, _one)
    try:
        steps = config["num_steps"] or _length(env)
        if steps is None:
            raise ConfigError(
                f"env.id={config['id']} does not say how long episodes are: give env.num_steps=…"
            )
        if config["cost_keys"] is not None:
            return list(config["cost_keys"]), steps
        entries = (*env.observation_spec.keys(), *env.full_reward_spec.keys())
        return [str(key) for key in entries if is_cost(key)], steps
    finally:
        env.close(raise_if_closed=False)


def _tried(config: Mapping[str, Any], make_some: Callable[[MakeEnv], EnvBase]) -> EnvBase:
    """Make some with the function that makes one; failures become errors of the configuration."""
    name, kwargs = config["id"], dict(config["kwargs"] or {})
    if kwargs.get("from_pixels"):
        load_backend()
    if "." in name:
        made: MakeEnv = partial(locate(name, key="env.id"), **kwargs)
    else:
        made = partial(getattr(torchrl.envs, name), **{**TORCHRL_CLASSES[name], **kwargs})
    make = partial(_with_infos, made, config["cost_keys"] or [], config["num_steps"])
    try:
        return make_some(make)
    except _FAILURES as error:
        raise ConfigError(f"env.id={name}: {type(error).__name__}: {error}") from error


def _with_infos(
    make: MakeEnv, cost_keys: Sequence[str], num_steps: int | None, **kwargs: Any
) -> EnvBase:
    """One that also says what stands in the `info` of an environment of Gymnasium's."""
    env = make(**kwargs)
    if isinstance(env, GymLikeEnv):
        known = (*env.observation_spec.keys(), *env.full_reward_spec.keys())
        reported = [key for key in cost_keys if key not in known]
        if reported:
            env.set_info_dict_reader(CostReader(reported, env.batch_size, patience=num_steps))
    return env


def _takes_number(make: MakeEnv) -> bool:
    """Whether the class, or function, that is innermost in partial functions takes `num_envs`."""
    found: Any = make
    while isinstance(found, partial):
        found = found.args[0] if found.func is _with_infos else found.func
    made = found.__init__ if inspect.isclass(found) else found
    return "num_envs" in inspect.signature(made).parameters


def _one(make: MakeEnv) -> EnvBase:
    return make(num_envs=1) if _takes_number(make) else make()


def _batch(make: MakeEnv, num_envs: int) -> EnvBase:
    env = _one(make)
    if not env.batch_size and not env.batch_locked and _takes_rows(env):
        return Rows(env, num_envs)
    if list(env.batch_size) == [num_envs]:
        return env
    env.close(raise_if_closed=False)
    if not env.batch_size:
        return SerialEnv(num_envs, make)
    many = make(num_envs=num_envs)
    if list(many.batch_size) != [num_envs, 1]:  # of MuJoCo's own library, which is in line anyway
        return many
    return SerialEnv(num_envs, partial(_alone, make))


def _alone(make: MakeEnv) -> EnvBase:
    """One of batch size [1] without that dimension, for others to put in line."""
    return TransformedEnv(_one(make), BatchSizeTransform(reshape_fn=methodcaller("squeeze", 0)))


def _takes_rows(env: EnvBase) -> bool:
    """Whether it does as `batch_locked=False` promises, which not every class keeps."""
    try:
        env.reset(TensorDict(batch_size=[2], device=env.device))
    except Exception:  # whatever its own code stumbles over
        return False
    return True


def _length(env: EnvBase) -> int | None:
    """What an environment, or that of Gymnasium within it, says of its episodes."""
    known = getattr(env, "max_episode_steps", None)
    if known is None and isinstance(env, GymLikeEnv):
        known = getattr(env.spec, "max_episode_steps", None)
    return known if isinstance(known, int) else None
