"""The base class of transforms of constrained problems, and an environment with transforms.

An environment with transforms is again a constrained environment.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from typing import Any

import torch
from omegaconf import OmegaConf
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.transforms import Compose, Transform, VecNorm, VecNormV2

from safe_rl.checks import Checked
from safe_rl.envs import rng
from safe_rl.envs.contract import ConstrainedEnv
from safe_rl.envs.keys import is_cost
from safe_rl.naming import did_you_mean
from safe_rl.trust import TargetError, instantiate

_STATE = "transforms"
# Attributes of the inner environment, which the defaults of `ConstrainedEnv` would hide.
_INNER = (
    *("max_episode_steps", "seconds_per_step", "events", "sensor_keys", "return_key"),
    *("reuses_tensors", "steps_after_end", "privileged_layout", "get_positions", "render"),
)


class ConstraintTransform(Checked, Transform):
    """Base class of transforms that keep the environment's contract and have a saved state.

    A subclass stores the state of every row's episode in `_rows`, tensors [..., m] by name. `start`
    returns their values at the start of an episode, and `_step` updates them.

    Attributes:
        evaluating: Whether policies are evaluated; then changes that only help learning are off.
        added_costs: Names of the costs that the transform adds.
        needed_costs: Names of the costs that the environment must have.
        return_key: Key of the environment's own reward, from which returns are computed, if the
            transform changes the reward.
        steps_per_decision: Steps of the environment per call of `step`. A transform that takes
            several must be the last one; those before it act at every step.
    """

    evaluating = False
    added_costs: tuple[str, ...] = ()
    needed_costs: Collection[str] = ()
    return_key: str | None = None
    steps_per_decision: int = 1

    def __init__(self) -> None:
        super().__init__()
        self._rows: dict[str, Tensor] = {}

    def seed(self, seeds: Tensor) -> None:
        """Seed all later draws with one key per row, int64 [N]; used from the next reset on."""

    def start(self, done: Tensor) -> dict[str, Tensor]:
        """Return `_rows` at the start of an episode, for all rows of `done` [..., 1]."""
        return {}

    def rows(self) -> dict[str, Tensor]:
        """Return a copy of `_rows`, for a snapshot."""
        return {name: value.clone() for name, value in self._rows.items()}

    def put_rows(self, rows: Mapping[str, Tensor]) -> None:
        """Restore what `rows` returned."""
        self._rows = {name: value.clone() for name, value in rows.items()}

    def continue_from(self, steps: int) -> None:
        """Continue schedules after this number of steps per row in earlier parts of the run."""

    def check(self, cost_keys: Collection[str]) -> None:
        """Raise ValueError if a needed cost is not among these."""
        check_known(self.needed_costs, cost_keys)

    def highest_cost(self, key: str, highest: float, of_a_step: float) -> float:
        """Return the highest possible cost of an episode.

        `highest` is the one without the transform, and `of_a_step` the highest cost of a step.
        """
        return highest

    def extend_layout(self, layout: Mapping[str, slice]) -> dict[str, slice]:
        """Add the columns of the transform's own observations."""
        return dict(layout)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        done = tensordict_reset.get("done")
        first = self.start(done)
        begins = tensordict.get("_reset", None)
        if begins is not None and self._rows:
            mask = begins.reshape(done.shape)
            first = {n: torch.where(mask, value, self._rows[n]) for n, value in first.items()}
        self._rows = first
        return self._call(tensordict_reset)


def check_known(names: Collection[str], cost_keys: Collection[str]) -> None:
    """Raise ValueError for an unknown cost."""
    for key in (name for name in names if name not in cost_keys):
        hint, known = did_you_mean(key, cost_keys), ", ".join(cost_keys) or "none"
        raise ValueError(f"There is no cost '{key}'.{hint} There are {known}.")


def costs_of(step: TensorDictBase, keys: Collection[str]) -> Tensor:
    """Return k costs of a step as float64 [..., k]; ValueError for an unknown one."""
    check_known(keys, list(filter(is_cost, step.keys())))
    return torch.cat([step[key] for key in keys], -1).double()


def unbounded_like(spec: TensorSpec) -> TensorSpec:
    """Remove the bounds of a spec; a spec of integers is returned unchanged."""
    if not spec.dtype.is_floating_point:
        return spec
    return Unbounded(shape=spec.shape, dtype=spec.dtype, device=spec.device)


def widen(spec: Composite, number: int, who: str) -> Composite:
    """Add columns to the spec of the observation; ValueError, naming `who`, for no vector."""
    seen = spec["observation"]
    if len(seen.shape) != len(spec.shape) + 1:
        raise ValueError(
            f"{who} adds columns, so the observation must be one vector, not a dictionary or a "
            "picture: set env.observation_flatten=true in Safety Gym, else env.flatten=true."
        )
    shape = (*seen.shape[:-1], seen.shape[-1] + number)
    spec["observation"] = Unbounded(shape, dtype=seen.dtype, device=seen.device)
    return spec


class TransformedConstrainedEnv(ConstrainedEnv, TransformedEnv):
    """N environments with transforms, made by `transform_env`.

    Everything that no transform changes is read from the inner environment.

    Attributes:
        cost_keys: Costs of the inner environment, then those of the transforms.
        return_key: Entry below "next" from which returns are computed, `reward` by default.
    """

    def __init__(
        self, base_env: ConstrainedEnv, transforms: Mapping[str, Transform], seed: int | None = None
    ) -> None:
        super().__init__(base_env, Compose(*transforms.values()))
        for name in _INNER:
            setattr(self, name, getattr(base_env, name))
        self._ours = {n: t for n, t in transforms.items() if isinstance(t, ConstraintTransform)}
        self.cost_keys = list(base_env.cost_keys)
        layout = dict(base_env.observation_layout)
        for name, transform in self._ours.items():
            try:
                transform.check(self.cost_keys)
                layout = transform.extend_layout(layout)
                for key in transform.added_costs:
                    if key in self.cost_keys or not is_cost(key):
                        raise ValueError(
                            f"cost_key={key}: choose another name, cost_<kind>, which no other "
                            "cost has."
                        )
            except ValueError as error:
                raise ValueError(f"transforms.{name}: {error}") from error
            self.cost_keys += transform.added_costs
            if self.return_key == "reward":  # the first copy is the environment's own reward
                self.return_key = transform.return_key or "reward"
        self.observation_layout = layout
        self._seed_transforms(seed)

    @property
    def action_bounds(self) -> tuple[Tensor, Tensor] | None:
        """Bounds of the inner environment's own units."""
        return self.base_env.action_bounds

    @property
    def steps_per_decision(self) -> int:
        """Steps of the environment that one call of `step` takes."""
        steps = (transform.steps_per_decision for transform in self._ours.values())
        return math.prod(steps, start=self.base_env.steps_per_decision)

    def highest_cost(self, key: str) -> float:
        """Return the highest possible cost of an episode, with all transforms."""
        # the inner environment does not know the costs that transforms add
        known = key in self.base_env.cost_keys
        highest = self.base_env.highest_cost(key) if known else super().highest_cost(key)
        of_a_step = super().highest_cost(key) / self.max_episode_steps
        for transform in self._ours.values():
            highest = transform.highest_cost(key, highest, of_a_step)
        return highest

    def rand_action(self, tensordict: TensorDictBase | None = None) -> TensorDictBase:
        """Draw actions from the spec, which transforms may have changed."""
        return EnvBase.rand_action(self, tensordict)

    def set_seed(self, seed: int | None = None, static_seed: bool = False) -> int | None:
        """Seed all later random draws of the environment and of its transforms."""
        self._seed_transforms(seed)
        return super().set_seed(seed, static_seed)

    def _seed_transforms(self, seed: int | None) -> None:
        if seed is None:
            return
        rows = rng.row_seeds(seed, self.batch_size.numel())
        for number, transform in enumerate(self._ours.values(), 1):
            # negative numbers, because environments fold with the number of the episode
            transform.seed(rng.fold(rows, -number))

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        # TorchRL would keep this entry of the last step, because `base_env` does not write it
        return super()._step(tensordict.exclude(("next", self.return_key)))

    def continue_from(self, steps: int) -> None:
        """Continue schedules after this number of steps per row, from the next reset on."""
        self.steps_before = steps
        self.base_env.continue_from(steps)
        for transform in self._ours.values():
            transform.continue_from(steps)

    def get_state(self) -> TensorDictBase | None:
        """Return a copy of the complete state, a TensorDict [N].

        None if the inner environment or one of the transforms cannot be stored; also if
        `append_transform` or `insert_transform` has added one.
        """
        stores = all(t in self._ours.values() for t in self.transform.transforms)
        state = self.base_env.get_state() if stores else None
        if state is None:
            return None
        for name, transform in self._ours.items():
            if rows := transform.rows():
                state.set((_STATE, name), TensorDict(rows, batch_size=self.batch_size))
        return state

    def set_state(self, state: TensorDictBase) -> TensorDictBase:
        """Set a state; a transform that is missing in it starts an episode."""
        # the inner environment may have transforms, too
        inside = state.exclude(*((_STATE, name) for name in self._ours)).filter_empty_()
        reset = self.base_env.set_state(inside)
        for name, transform in self._ours.items():
            rows = state.get((_STATE, name), None)
            if rows is not None:
                transform.put_rows(dict(rows.items()))
                reset = transform._call(reset)
            else:
                reset = transform._reset(reset.empty(), reset)
        return reset


def transform_env(
    env: ConstrainedEnv,
    transforms: Mapping[str, Transform | Mapping[str, Any]],
    *,
    evaluating: bool,
    seed: int | None = None,
) -> TransformedConstrainedEnv:
    """Apply transforms to a constrained environment.

    The environment can be saved (`get_state`) if every transform is a `ConstraintTransform`.

    Args:
        env: A constrained environment.
        transforms: Name -> transform, or node of a configuration with a `_target_`. The first is
            the innermost: it reads the environment's own costs, and is the last to change actions.
        evaluating: Whether policies are evaluated: rewards and lengths of episodes are then the
            environment's own.
        seed: Seed of the transforms' random draws; None draws one from torch's generator.

    Raises:
        TypeError: If they are no mapping.
        ValueError: If a value is out of range, or a transform does not fit the environment.

    Examples:
        >>> from safe_rl.envs import make_env
        >>> from safe_rl.envs.transforms import ActionFilter
        >>> env = make_env("PointGoal1", num_envs=2, seed=0)
        >>> slow = ActionFilter(lambda step: 0.5 * step["action"])
        >>> transform_env(env, {"slow": slow}, evaluating=False).cost_keys[-1]
        'cost_interventions'
    """
    if not isinstance(transforms, Mapping):
        raise TypeError(f"transforms must be a mapping, name -> transform, got {transforms!r}.")
    built = {name: _transform(name, given) for name, given in transforms.items()}
    for transform in built.values():
        if isinstance(transform, ConstraintTransform):
            transform.evaluating = evaluating
    held = [name for name, t in built.items() if getattr(t, "steps_per_decision", 1) != 1]
    if len(held) > 1:
        raise ValueError(f"transforms: '{held[0]}' and '{held[1]}' hold actions: choose one.")
    if held and held != list(built)[-1:]:
        raise ValueError(
            f"transforms: '{held[0]}' has to be the last one, because the others count steps of "
            f"the environment: transforms=[{','.join([n for n in built if n != held[0]])},"
            f"{held[0]}]."
        )
    if held and len(built) > 1:
        # The last transform takes several steps of an inner environment, which has all the others.
        last = {held[0]: built.pop(held[0])}
        return TransformedConstrainedEnv(TransformedConstrainedEnv(env, built, seed), last, seed)
    return TransformedConstrainedEnv(env, built, seed)


def _transform(name: str, given: Transform | Mapping[str, Any]) -> Transform:
    if isinstance(given, Transform):
        return given
    # messages have the full key of the node
    node = OmegaConf.create({"transforms": {name: given}}, flags={"allow_objects": True})
    transform = instantiate(node.transforms[name])
    if isinstance(transform, VecNorm | VecNormV2):
        raise TargetError(
            f"transforms.{name}: evaluations would not have the statistics of training. Use "
            "model.normalise=10 for observations, RewardScaling for rewards."
        )
    return transform
