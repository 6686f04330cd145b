"""The contract of a batch of constrained environments.

Training, evaluation and the command line use only this part of an environment.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Categorical, Composite, OneHot, TensorSpec
from torchrl.envs import EnvBase

from safe_rl.envs.keys import COST


class ConstrainedEnv(EnvBase):
    """A batch of N environments that are stepped together: an `EnvBase` of batch size [N].

    It reads `action`: bounded numbers [N, A], or choices as integers [N] or [N, A], or as one-hot
    vectors [N, C]. A policy may draw continuous actions outside the bounds; the environment clips
    them. (An untrained policy draws from about -1 to 1.) It writes `observation` (vectors of
    float32, or pictures), `reward` [N, 1], each of `cost_keys` [N, 1] (0 or more), `done`,
    `terminated` and `truncated`. The costs are part of the reward spec.

    Attributes:
        cost_keys: Names of the costs; the aggregate `cost` is one of them. It has no default.
        max_episode_steps: Largest number of steps of an episode. It has no default.
        observation_layout: Columns of every named component of a flat `observation`. If the
            observation is nested, the columns that it would have if it were flat. It has no
            default.
        privileged_layout: Columns of every named component of the entry `privileged` [N, m], which
            critics may read and actors never do; empty (the default) if it is not written.
        return_key: Key below "next" of the rewards that returns are computed from.
        events: Names of entries [N, 1] (bool) that say what happened in a step.
        seconds_per_step: Simulated time of a step [s]; None if unknown.
        steps_per_decision: Environment steps that one call of `step` takes. If it is not 1, each
            call writes their number to `steps_taken` [N, 1]: it is lower where an episode ends.
        steps_before: Steps of every row in earlier parts of the run.
        sensor_keys: Keys of the configuration on which the meaning of columns depends.
        first_steps: Numbers of steps [N] that the episodes of the next reset count as taken; None
            (the default) is 0. Only for environments whose state has `step_count`.
        render: Method that draws pictures as `SimulatedEnv.render` does; None if there is none.

    Examples:
        >>> from safe_rl.envs import SafetyGymEnv
        >>> env: ConstrainedEnv = SafetyGymEnv("PointGoal1", num_envs=2, seed=0)
        >>> env.max_episode_steps
        1000
    """

    cost_keys: list[str]
    max_episode_steps: Any
    observation_layout: Any
    return_key: str = "reward"
    events: tuple[str, ...] = ()
    privileged_layout: Mapping[str, slice] = {}
    sensor_keys: Mapping[str, Any] = MappingProxyType({})
    seconds_per_step: Any = None
    steps_per_decision: Any = 1
    steps_before: int = 0
    first_steps: Tensor | None = None
    render: Any = None
    #: Whether `_step` and `_reset` may return the tensors of an earlier call, as environments of
    #: users may; then what they return is copied.
    reuses_tensors: bool = True
    #: Whether `_step` may be called for rows that have ended, if nobody reads what they return.
    steps_after_end: bool = False

    @property
    def action_bounds(self) -> tuple[Tensor, Tensor] | None:
        """Lowest and highest action [A] in the environment's own units; None for choices.

        The action spec has other bounds where actions are rescaled on their way (`env=gymnasium`).
        """
        return bounds_of(self.action_spec_unbatched)

    @property
    def column_names(self) -> list[str]:
        """Names of the columns of a flat observation: ``gyro[0]``, ``gyro[1]`` and so on."""
        names: dict[int, str] = {}
        for name, columns in self.observation_layout.items():
            places = range(columns.start or 0, columns.stop)
            single = len(places) == 1
            names |= {at: name if single else f"{name}[{n}]" for n, at in enumerate(places)}
        return [names.get(at, f"column[{at}]") for at in range(max(names, default=-1) + 1)]

    @property
    def interface(self) -> dict[str, Any]:
        """What numbers mean for a policy, JSON-compatible; recordings and checkpoints keep it.

        ``columns`` are `column_names`, ``sensors`` the `sensor_keys`. ``actions`` has the bounds of
        actions as policies choose them, ``low`` and ``high``, and in the environment's own units,
        ``own_low`` and ``own_high``; None for choices. ``steps_per_decision`` is the attribute.
        """
        actions = None
        if (own := self.action_bounds) is not None:
            spec = self.action_spec_unbatched
            bounds = {"low": spec.low, "high": spec.high, "own_low": own[0], "own_high": own[1]}
            actions = {name: bound.flatten().tolist() for name, bound in bounds.items()}
        return {
            "columns": self.column_names,
            "sensors": dict(self.sensor_keys),
            "actions": actions,
            "steps_per_decision": self.steps_per_decision,
        }

    def get_state(self) -> Any:
        """Return a copy of everything that determines what happens next, a TensorDict [N].

        None (the default) if it cannot be stored: a resumed run then begins new episodes.
        """
        return None

    def set_state(self, state: TensorDictBase) -> TensorDictBase:
        """Set the environments to a state from `get_state`; return what a reset returns."""
        raise NotImplementedError(f"{type(self).__name__} cannot store its state.")

    def add_steps(self, steps: Tensor) -> TensorDictBase:
        """Add `steps` [N] to the steps of the present episodes; return what a reset returns.

        Raises:
            KeyError: If the state has no `step_count`.
        """
        state = self.get_state()
        taken = state["step_count"]
        state["step_count"] = taken + steps.reshape(-1, *[1] * (taken.ndim - 1)).to(taken)
        return self.set_state(state)

    def reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        """Begin episodes as `EnvBase.reset` does, at first those after `first_steps`."""
        begun = super().reset(tensordict, **kwargs)
        begun = begun.clone() if self.reuses_tensors else begun
        if self.first_steps is not None:
            steps, self.first_steps = self.first_steps, None
            begun.update(self.add_steps(steps))
        return begun

    def get_positions(self) -> TensorDictBase:
        """Return object positions by kind, a TensorDict [N] of [N, K, 3] (m); by default empty."""
        return TensorDict(batch_size=self.batch_size)

    def highest_cost(self, key: str) -> float:
        """Return the largest cost of an episode: calls of `step` times the bound in the spec.

        It is infinite if the spec has no bound.
        """
        spec = self.full_reward_spec[key]
        highest = float(spec.high.max()) if hasattr(spec, "high") else math.inf
        # the largest number of the dtype stands for no bound
        is_bounded = highest < torch.finfo(torch.float32).max
        calls = self.max_episode_steps / self.steps_per_decision
        return highest * calls if is_bounded else math.inf

    def any_done(self, tensordict: TensorDictBase) -> bool:
        """Return whether any episode has ended, and write to `_reset` which ones.

        TorchRL's method returns a tensor. The host would wait for the device to compute it, and
        again to read it.
        """
        done = tensordict.get("done")
        if has_ended := bool(done.any()):
            tensordict.set("_reset", done.clone())
        return has_ended

    def _step_proc_data(self, next_tensordict_out: TensorDictBase) -> TensorDictBase:
        try:
            after = super()._step_proc_data(next_tensordict_out)
        except (AttributeError, RuntimeError) as error:
            written = {key: next_tensordict_out.get(key, None) for key in self.reward_keys}
            shapes = {str(key): None if v is None else list(v.shape) for key, v in written.items()}
            if all(shape == [*self.batch_size, 1] for shape in shapes.values()):
                raise  # for another reason
            raise ContractError(
                f"{type(self).__name__}._step must write {[*self.batch_size, 1]} numbers for each "
                f"of {', '.join(shapes)}. It wrote the shapes {shapes}."
            ) from error
        return after.clone() if self.reuses_tensors else after

    def continue_from(self, steps: int) -> None:
        """Continue schedules after this number of steps per row in earlier parts of the run."""
        self.steps_before = steps


def bounds_of(spec: TensorSpec) -> tuple[Tensor, Tensor] | None:
    """Return the bounds of continuous actions, float32 on the CPU; None for choices."""
    if not isinstance(spec, Bounded) or not spec.dtype.is_floating_point:
        return None
    return spec.low.float().cpu(), spec.high.float().cpu()


def add_columns(layout: Mapping[str, slice], sizes: Mapping[str, int]) -> dict[str, slice]:
    """Return a layout with further components, of given sizes, after its last column.

    Examples:
        >>> add_columns({"gyro": slice(0, 3)}, {"lidar": 16})
        {'gyro': slice(0, 3, None), 'lidar': slice(3, 19, None)}
    """
    extended, first = dict(layout), max((columns.stop for columns in layout.values()), default=0)
    for name, size in sizes.items():
        extended[name], first = slice(first, first + size), first + size
    return extended


class ContractError(ValueError):
    """An environment does not fulfil the contract; the message lists what is missing."""


def check_constrained_env(env: Any) -> None:
    """Check a custom environment against the contract, without stepping it.

    TorchRL's `check_env_specs` steps it, and checks that the outputs agree with the specs.

    Raises:
        ContractError: If anything is missing or wrong; the message lists all of it.

    Examples:
        >>> from torchrl.envs import PendulumEnv
        >>> check_constrained_env(PendulumEnv())  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        ...
        safe_rl.envs.contract.ContractError: PendulumEnv is not derived from ...
    """
    if not isinstance(env, ConstrainedEnv):
        raise ContractError(
            f"{type(env).__name__} is not derived from safe_rl.envs.ConstrainedEnv. For an "
            "environment of Gymnasium use safe_rl.envs.from_gymnasium, for one of TorchRL "
            "env=torchrl."
        )
    if problems := [*_problems_of_specs(env), *_problems_of_attributes(env)]:
        lines = "".join(f"\n- {problem}" for problem in problems)
        raise ContractError(f"{type(env).__name__} is no constrained environment:{lines}")


def _problems_of_specs(env: ConstrainedEnv) -> Iterator[str]:
    if len(env.batch_size) != 1:
        yield (
            f"its batch size must be [N], got {list(env.batch_size)}; "
            "torchrl.envs.SerialEnv makes a batch of single environments."
        )
    seen = env.observation_spec.get("observation", None)
    if seen is None:
        yield f"it must observe 'observation', got {sorted(map(str, env.observation_spec.keys()))}."
    parts = seen.values(True, True) if isinstance(seen, Composite) else [seen]
    for part in parts if seen is not None else ():
        if len(part.shape) == 2 and part.dtype != torch.float32:
            yield f"'observation' must be of float32, which networks take, got {part.dtype}."
    if not isinstance(env.action_spec, Bounded | Categorical | OneHot):
        kind = type(env.action_spec).__name__
        yield f"its actions must be continuous and bounded, or choices, got {kind}."
    ends = {str(key) for key in env.full_done_spec.keys(True, True)}
    for key in sorted({"done", "terminated", "truncated"} - ends):
        yield f"its done spec must have '{key}', got {sorted(ends)}."


def _problems_of_attributes(env: ConstrainedEnv) -> Iterator[str]:
    steps, keys, layout = (
        getattr(env, name, None)
        for name in ("max_episode_steps", "cost_keys", "observation_layout")
    )
    if isinstance(steps, bool) or not isinstance(steps, int) or steps < 1:
        yield f"'max_episode_steps' must be the largest number of steps of an episode, got {steps}."
    stores, restores = (
        getattr(type(env), name) is not getattr(ConstrainedEnv, name)
        for name in ("get_state", "set_state")
    )
    if stores and not restores:
        yield "it has 'get_state', so it needs 'set_state' too."
    if not isinstance(keys, list | tuple) or COST not in keys:
        yield f"'cost_keys' must be a list of names with '{COST}' among them, got {keys}."
        keys = ()
    spec, wanted = env.full_reward_spec, (*env.batch_size, 1)
    shapes = {str(key): tuple(spec[key].shape) for key in spec.keys(True, True)}
    for key in ("reward", *keys):
        if shapes.get(key) != wanted:
            yield f"its reward spec must have '{key}' of the shape {wanted}, got {shapes}."
    if not isinstance(layout, Mapping) or not all(isinstance(s, slice) for s in layout.values()):
        yield (
            "'observation_layout' must map names to columns of 'observation', such as "
            f"{{'observation': slice(0, n)}}, got {layout}."
        )
        return
    seen = env.observation_spec.get("observation", None)
    width = math.inf if seen is None or len(seen.shape) != 2 else seen.shape[-1]
    for name, columns in layout.items():
        if (columns.stop or 0) > width:
            yield f"'observation_layout' has {columns} for '{name}', beyond the {width} columns."
