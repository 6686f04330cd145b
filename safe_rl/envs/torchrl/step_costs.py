"""What a step costs: entries of the environment, ranges that it leaves, a function of the user's.

All of them are functions of a step as TorchRL has it: what was before and the action that was taken
at the root, what is after below "next".
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite
from torchrl.envs.transforms import Transform

from safe_rl.envs.costs import COST, CostRange, is_cost, parse_entries
from safe_rl.envs.errors import ConfigError, nearest
from safe_rl.envs.gymnasium.gymnasium_env import cost_spec
from safe_rl.targets import locate

__all__ = ["CostsBesideRewards", "StepCosts", "dotted", "entry_key"]

CostFunction = Callable[[TensorDictBase], Tensor | Mapping[str, Tensor]]


def entry_key(name: str) -> NestedKey:
    """Return the key of an entry that is named with dots.

    Examples:
        >>> entry_key("params.g"), entry_key("thdot")
        (('params', 'g'), 'thdot')
    """
    parts = tuple(name.split("."))
    return parts[0] if len(parts) == 1 else parts


def dotted(key: NestedKey) -> str:
    """Return the name of a key, with dots where it is nested."""
    return ".".join(key) if isinstance(key, tuple) else str(key)


class StepCosts:
    """All costs of a step, by name, the sum first.

    Args:
        entries: Names of entries that are costs.
        outside: Name of a cost -> range, as `parse_entries` takes them.
        function: Makes others, [N] or [N, 1], one that is called `cost` or several by name:
            `module:function`, or a node with its arguments; None makes none.

    Raises:
        ConfigError: If there are no costs at all, or `function` names none.
        TargetError: If the module of the function was not named by `import=`.

    Examples:
        >>> from tensordict import TensorDict
        >>> costs = StepCosts([], {"cost_speed": ["thdot", -4, 4]}, None)
        >>> step = TensorDict({"next": {"thdot": torch.tensor([3.0, -5.0])}}, [2])
        >>> {name: cost.flatten().tolist() for name, cost in costs(step).items()}
        {'cost': [0.0, 1.0], 'cost_speed': [0.0, 1.0]}
    """

    def __init__(self, entries: Sequence[str], outside: Any, function: Any) -> None:
        self.entries = list(entries)
        self._ranges = parse_entries("outside", outside)
        self._function = None if function is None else _located(function)
        if not (self.entries or self._ranges or self._function):
            raise ConfigError(
                "what does a step cost? Name entries that are costs (env.cost_keys=[…]), the range "
                "that one has to stay in (env.outside='{cost_speed: [thdot, -4, 4]}'), or a "
                "function of yours (import=my_module env.cost=my_module:speed)."
            )

    @property
    def highest(self) -> dict[str, float]:
        """The most that a step can cost, by name, where that is known: 1 of leaving a range."""
        known = dict.fromkeys(self._ranges, 1.0)
        # entries and functions may have a cost of their own that is called so
        if known and COST not in known and not self.entries and self._function is None:
            known[COST] = float(len(known))
        return known

    def __call__(self, step: TensorDictBase) -> dict[str, Tensor]:
        """Costs [N, 1] of a step [N].

        Raises:
            ConfigError: For an entry that there is not, or what is no cost of N rows.
        """
        found = [(name.rpartition(".")[2], _entry(step, name)) for name in self.entries]
        found += [(name, _outside(step, kept)) for name, kept in self._ranges.items()]
        if self._function is not None:
            own = self._function(step)
            found += _named(own)
        costs: dict[str, Tensor] = {}
        for name, cost in found:
            if name in costs:
                raise ConfigError(f"There are two costs called '{name}'.")
            if not isinstance(cost, Tensor) or cost.numel() != step.batch_size.numel():
                shown = list(cost.shape) if isinstance(cost, Tensor) else type(cost).__name__
                raise ConfigError(
                    f"The cost '{name}' must be one number per row, [N], got {shown}."
                )
            costs[name] = cost.float().reshape(*step.batch_size, 1)
        if COST in costs:
            return {COST: costs.pop(COST), **costs}
        return {COST: torch.stack(list(costs.values())).sum(0), **costs}


def _located(given: Any) -> CostFunction:
    node = dict(given) if isinstance(given, Mapping) else {"_target_": given}
    target = node.pop("_target_", None)
    if not isinstance(target, str):
        raise ConfigError(
            f"'cost' names a function: my_module:speed, or '{{_target_: my_module.speed, limit: 4}}"
            f"' with its arguments; got {given!r}."
        )
    return partial(locate(target.replace(":", "."), key="env.cost"), **node)


def _entry(step: TensorDictBase, name: str) -> Tensor:
    after = step["next"]
    value = after.get(entry_key(name), None)
    if value is None:
        known = list(map(dotted, after.keys(True, True)))
        raise ConfigError(
            f"There is no entry '{name}'.{nearest(name, known)} A step writes {', '.join(known)}."
        )
    return value


def _outside(step: TensorDictBase, kept: CostRange) -> Tensor:
    values = _entry(step, kept.entry).reshape(*step.batch_size, -1)
    if kept.column >= values.shape[-1]:
        raise ConfigError(
            f"'outside': column {kept.column} of {kept.entry}, which has {values.shape[-1]}, "
            "counted from 0."
        )
    value = values[..., kept.column]
    return (value < kept.low) | (value > kept.high)


def _named(returned: Any) -> list[tuple[str, Any]]:
    if not isinstance(returned, Mapping):
        return [(COST, returned)]
    for name in returned:
        if not is_cost(name):
            raise ConfigError(f"env.cost returns '{name}': costs are called cost or cost_<kind>.")
    return list(returned.items())


class CostsBesideRewards(Transform):
    """Writes the costs of a step beside its reward.

    Args:
        costs: From a step to costs [N, 1] by name.
        names: What they are called.
    """

    def __init__(self, costs: StepCosts, names: Sequence[str]) -> None:
        super().__init__()
        self._costs, self._names = costs, list(names)
        self._taken = [entry_key(name) for name in costs.entries]

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        costs = self._costs(tensordict.clone(False).set("next", next_tensordict))
        return next_tensordict.exclude(*self._taken).update(costs)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return tensordict_reset.exclude(*self._taken)

    def transform_output_spec(self, output_spec: Composite) -> Composite:
        """Add the costs to the rewards, and take what are costs out of the observations."""
        output_spec = super().transform_output_spec(output_spec)
        observed, rewards = output_spec["full_observation_spec"], output_spec["full_reward_spec"]
        for spec in (observed, rewards):
            for key in self._taken:
                if key in spec.keys(True):
                    del spec[key]
        highest = self._costs.highest
        for name in self._names:
            shape = (*rewards.shape, 1)
            rewards[name] = cost_spec(highest.get(name), shape, rewards.device)
        return output_spec
