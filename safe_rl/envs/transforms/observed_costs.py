"""What a step cost is observed with the next observation."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded

from safe_rl.envs.transforms.base import ConstraintTransform, check_known, costs_of
from safe_rl.ranges import Text, Weight

LAST, TRACE = "last_costs", "cost_traces"


class ObservedCosts(ConstraintTransform):
    """The last step's costs and a trace of those before them become part of the observation.

    Costs may have causes that no sensor shows: a vase that was touched costs as long as it moves.
    A policy that reads its costs can tell that state from others. This is more than the published
    observation, and the policy needs it in use as well: say so beside every result.

    The trace e of a cost c is e ← decay · e + (1 − decay) · c, a mean over the last 1 / (1 − decay)
    steps. `observation` gets 2 columns per cost, the components `last_costs` and `cost_traces`.
    Both are 0 when an episode begins. It is on in evaluation too.

    Args:
        decay: Weight of the past in the trace.
        costs: Names of the costs that are observed; None: all.

    Raises:
        ValueError: for a decay out of range, an unknown cost, or an observation that is no vector.

    Examples:
        >>> from safe_rl.envs import make_env
        >>> env = make_env("PointGoal2", seed=0, transforms={"seen": ObservedCosts(decay=0.95)})
        >>> len(env.cost_keys)
        5
        >>> env.observation_layout["last_costs"], env.observation_layout["cost_traces"]
        (slice(60, 65, None), slice(65, 70, None))
    """

    def __init__(self, decay: Weight, costs: Sequence[Text] | None = None) -> None:
        super().__init__()
        if not 0 <= decay < 1:
            raise ValueError(f"decay={decay:g} must be in [0, 1).")
        self._decay = decay
        self._costs = None if costs is None else list(costs)

    def check(self, cost_keys: Collection[str]) -> None:
        """Take note of the costs there are; raise ValueError for one that there is not."""
        self._costs = list(cost_keys) if self._costs is None else self._costs
        check_known(self._costs, cost_keys)

    def extend_layout(self, layout: Mapping[str, slice]) -> dict[str, slice]:
        """Add the components `last_costs` and `cost_traces`."""
        first, size = max((c.stop for c in layout.values()), default=0), len(self._costs or ())
        ends = slice(first, first + size), slice(first + size, first + 2 * size)
        return {**layout, LAST: ends[0], TRACE: ends[1]}

    def start(self, done: Tensor) -> dict[str, Tensor]:
        """Return that nothing has cost anything."""
        shape = (*done.shape[:-1], len(self._costs or ()))
        return {name: torch.zeros(shape, device=done.device) for name in (LAST, TRACE)}

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        costs = costs_of(next_tensordict, self._costs or ()).float()
        self._rows = {LAST: costs, TRACE: torch.lerp(costs, self._rows[TRACE], self._decay)}
        return self._call(next_tensordict)

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        seen = next_tensordict.get("observation")
        return next_tensordict.set("observation", torch.cat([seen, *self._rows.values()], -1))

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Add the columns.

        Raises:
            ValueError: for pictures and dictionaries.
        """
        seen = observation_spec["observation"]
        if isinstance(seen, Composite) or len(seen.shape) != len(observation_spec.shape) + 1:
            raise ValueError(
                "observed_costs adds columns to an observation that is one vector, and this one is "
                "not: let the environment make one vector of it."
            )
        shape = (*seen.shape[:-1], seen.shape[-1] + 2 * len(self._costs or ()))
        observation_spec["observation"] = Unbounded(shape, device=seen.device, dtype=seen.dtype)
        return observation_spec
