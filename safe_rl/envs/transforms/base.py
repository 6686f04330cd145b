"""Base class and helper functions of transforms of constrained problems."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs.transforms import Transform

from safe_rl.checks import Checked
from safe_rl.envs.costs import is_cost
from safe_rl.naming import did_you_mean, key_name


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


def check_budgets(budgets: Mapping[str, float], *, above_zero: bool) -> dict[str, float]:
    """Check budgets, cost key -> cost per episode, and return them; ValueError for a wrong one."""
    checked = {key: float(budget) for key, budget in budgets.items()}
    if not checked:
        raise ValueError("budgets is empty: give the name of a cost and a budget per episode.")
    for key, budget in checked.items():
        if not (math.isfinite(budget) and (budget > 0 if above_zero else budget >= 0)):
            least = "above 0" if above_zero else "of at least 0"
            raise ValueError(f"budgets: {key}={budget:g} must be a number {least}.")
    return checked


def check_known(names: Collection[str], cost_keys: Collection[str]) -> None:
    """Raise ValueError for an unknown cost."""
    for key in (name for name in names if name not in cost_keys):
        hint, known = did_you_mean(key, cost_keys), ", ".join(cost_keys) or "none"
        raise ValueError(f"There is no cost '{key}'.{hint} There are {known}.")


def costs_of(step: TensorDictBase, keys: Collection[str]) -> Tensor:
    """Return k costs of a step as float64 [..., k]; ValueError for a missing one."""
    costs = [step.get(key, None) for key in keys]
    lacking = [key_name(key) for key, cost in zip(keys, costs, strict=True) if cost is None]
    if lacking:
        names = [key_name(key) for key in step.keys(True, True)]
        check_known(lacking, [name for name in names if is_cost(name.rpartition("/")[2])])
    return torch.cat(costs, -1).double()


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
            f"{who} adds columns, so the observation must be one vector, but it has the shape "
            f"{list(seen.shape)}: let the environment make one vector of it."
        )
    shape = (*seen.shape[:-1], seen.shape[-1] + number)
    spec["observation"] = Unbounded(shape, dtype=seen.dtype, device=seen.device)
    return spec
