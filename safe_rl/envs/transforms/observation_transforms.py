"""Transforms of observations: sensor noise, observed costs, states of recurrent policies."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Annotated

import torch
from annotated_types import Interval
from pydantic import NonNegativeFloat
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Composite, TensorSpec, Unbounded

from safe_rl.checks import Text, Weight, rule
from safe_rl.envs import rng
from safe_rl.envs.contract import add_columns
from safe_rl.envs.transforms.environment import (
    ConstraintTransform,
    check_known,
    costs_of,
    unbounded_like,
    widen,
)

_Range = Annotated[
    Sequence[NonNegativeFloat],
    rule(lambda row: len(row) == 2 and row[0] <= row[1], "the lowest and the highest value"),
]
_STD = -1  # differs from all step numbers, which are in the same place of a key


class SensorNoise(ConstraintTransform):
    """Add normally distributed noise to observations, also in evaluation.

    Every draw depends only on its row's seed, the episode, the step and the column. Therefore
    resumed runs are identical, and rows are independent. Pictures of integers are not changed. In
    TorchRL's own `TransformedEnv` the seeds are drawn once, at the first reset, from torch's
    generator, and `env.set_seed` does not change them.

    Args:
        std: Standard deviation of the noise, in the units of the observation; or the lowest and
            the highest one, from which every episode draws its own.

    Examples:
        >>> from safe_rl.envs import make_env
        >>> noise = SensorNoise(std=0.1)
        >>> env = make_env("PointGoal1", num_envs=2, seed=0, transforms={"noise": noise})
        >>> env.reset()["observation"].shape
        torch.Size([2, 60])
    """

    def __init__(self, std: NonNegativeFloat | _Range) -> None:
        super().__init__()
        self._std = std
        self._seeds: Tensor | None = None

    def seed(self, seeds: Tensor) -> None:
        """Seed all later draws with one key per row, int64 [N]; used from the next reset on."""
        self._seeds = seeds

    def put_rows(self, rows: Mapping[str, Tensor]) -> None:
        """Restore what `rows` returned; its random keys replace a seed not yet used."""
        super().put_rows(rows)
        self._seeds = None

    def start(self, done: Tensor) -> dict[str, Tensor]:
        """Return the random keys of the episodes, and the step 0."""
        key = self._rows.get("key")
        if self._seeds is not None:
            key, self._seeds = self._seeds.reshape(done.shape).to(done.device), None
        elif key is None:
            key = torch.randint(2**62, done.shape, device=done.device)
        else:
            key = rng.fold(key, 0)
        return {"key": key, "step": torch.zeros_like(key)}

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        self._rows = {**self._rows, "step": self._rows["step"] + 1}
        return self._call(next_tensordict)

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        observation = next_tensordict.get("observation")
        if isinstance(observation, Tensor):
            return next_tensordict.set("observation", self._with_noise(observation, 0))
        first = 0
        for name in sorted(observation.keys()):
            value = observation.get(name)
            next_tensordict.set(("observation", name), self._with_noise(value, first))
            first += value.shape[observation.ndim :].numel()
        return next_tensordict

    def _with_noise(self, value: Tensor, first: int) -> Tensor:
        """Add noise to numbers that are no integers; the draws' columns begin at `first`."""
        if not value.dtype.is_floating_point:
            return value
        key, step = self._rows["key"], self._rows["step"]
        flat = value.reshape(*key.shape[:-1], -1)
        columns = torch.arange(first, first + flat.shape[-1], device=flat.device)
        noise = self._std_of(key) * rng.normal(key, step, columns)
        return (flat + noise.to(flat.dtype)).reshape(value.shape)

    def _std_of(self, key: Tensor) -> Tensor | float:
        if isinstance(self._std, int | float):
            return self._std
        low, high = self._std
        return low + (high - low) * rng.uniform(key, _STD)

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Remove the bounds."""
        observed = observation_spec["observation"]
        parts = observed if isinstance(observed, Composite) else observation_spec
        for name in list(observed.keys()) if parts is observed else ["observation"]:
            parts[name] = unbounded_like(parts[name])
        return observation_spec


MEMORY, FIRST = "memory", "is_init"


class RecurrentState(ConstraintTransform):
    """Copy the recurrent state ``("next", "memory")`` of a policy to its next step as ``memory``.

    The state is 0 at the start of an episode, where `is_init` is True. TorchRL's `TensorDictPrimer`
    and `InitTracker` do the same, but this state is saved with the environment's. If a policy
    writes no state, the old one is kept.

    Args:
        size: Size of the recurrent state of a row.

    Examples:
        >>> from torchrl.envs import TransformedEnv
        >>> from safe_rl.envs import SafetyGymEnv
        >>> env = TransformedEnv(SafetyGymEnv("PointGoal1", num_envs=2, seed=0), RecurrentState(4))
        >>> state = env.reset()
        >>> state["memory"].shape, bool(state["is_init"].all())
        (torch.Size([2, 4]), True)
    """

    def __init__(self, size: Annotated[int, Interval(ge=1, le=16_384)]) -> None:
        super().__init__()
        self._size = size

    def start(self, done: Tensor) -> dict[str, Tensor]:
        """Return zeros as the state, and True for `is_init`."""
        nothing = torch.zeros(*done.shape[:-1], self._size, device=done.device)
        return {MEMORY: nothing, FIRST: torch.ones_like(done)}

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        memory = next_tensordict.get(MEMORY, self._rows[MEMORY])
        self._rows = {MEMORY: memory, FIRST: torch.zeros_like(self._rows[FIRST])}
        return self._call(next_tensordict)

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        return next_tensordict.update(self._rows)

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Add the memory, and whether an episode starts."""
        batch, device = observation_spec.shape, observation_spec.device
        observation_spec[MEMORY] = Unbounded(shape=(*batch, self._size), device=device)
        observation_spec[FIRST] = Binary(1, shape=(*batch, 1), dtype=torch.bool, device=device)
        return observation_spec


LAST, TRACE = "last_costs", "cost_traces"


class ObservedCosts(ConstraintTransform):
    """Add the costs of the last step, and a trace of earlier costs, to the observation.

    Costs may have causes that no sensor shows: a vase that was touched costs as long as it moves.
    The published observation does not contain the costs, and a policy needs them also when it is
    deployed. So mention this transform beside every result. The trace e of a cost c is
    e ← decay · e + (1 − decay) · c, a mean over about the last 1 / (1 − decay) steps. Both are 0
    when an episode begins.

    Args:
        decay: Weight of the past in the trace.
        costs: Names of the costs that are observed; None or an empty list: all.

    Examples:
        >>> from safe_rl.envs import make_env
        >>> env = make_env("PointGoal2", seed=0, transforms={"seen": ObservedCosts(decay=0.95)})
        >>> env.observation_layout["last_costs"], env.observation_layout["cost_traces"]
        (slice(60, 65, None), slice(65, 70, None))
    """

    def __init__(self, decay: Weight, costs: Sequence[Text] | None = None) -> None:
        super().__init__()
        self._decay = decay
        self._costs = list(costs or ())

    def check(self, cost_keys: Collection[str]) -> None:
        """Take all costs if none are named; raise ValueError for an unknown one."""
        self._costs = self._costs or list(cost_keys)
        check_known(self._costs, cost_keys)

    def _observed(self) -> list[str]:
        """Names of the observed costs; in TorchRL's `TransformedEnv`, `check` is not called."""
        return self._costs or list(self.container.cost_keys)

    def extend_layout(self, layout: Mapping[str, slice]) -> dict[str, slice]:
        """Add the components `last_costs` and `cost_traces`."""
        return add_columns(layout, dict.fromkeys((LAST, TRACE), len(self._costs)))

    def start(self, done: Tensor) -> dict[str, Tensor]:
        """Return zeros."""
        shape = (*done.shape[:-1], len(self._observed()))
        return {name: done.new_zeros(shape, dtype=torch.float32) for name in (LAST, TRACE)}

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        costs = costs_of(next_tensordict, self._observed()).float()
        self._rows = {LAST: costs, TRACE: torch.lerp(costs, self._rows[TRACE], self._decay)}
        return self._call(next_tensordict)

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        seen = next_tensordict.get("observation")
        return next_tensordict.set("observation", torch.cat([seen, *self._rows.values()], -1))

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Add the columns; ValueError for pictures and dictionaries."""
        return widen(observation_spec, 2 * len(self._observed()), "observed_costs")
