"""Transforms that write the costs of a step, and the entries that are observed."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor
from torch.nn.functional import one_hot
from torchrl.data import (
    Binary,
    Bounded,
    Categorical,
    Composite,
    MultiCategorical,
    NonTensor,
    TensorSpec,
    Unbounded,
)
from torchrl.envs import EnvBase
from torchrl.envs.transforms import Transform

from safe_rl.envs.contract import add_columns
from safe_rl.envs.foreign import parse_ranges
from safe_rl.envs.keys import COST, ConfigError, is_cost
from safe_rl.naming import did_you_mean
from safe_rl.trust import locate

_OBSERVATION, _PRIVILEGED = "observation", "privileged"


def entry_key(name: str) -> NestedKey:
    """Return the key of an entry; dots in its name separate the parts of a nested key."""
    return unravel_key(tuple(name.split(".")))


def dotted(key: NestedKey) -> str:
    """Return the name of a key; dots join the parts of a nested key."""
    return ".".join(key) if isinstance(key, tuple) else str(key)


class StepCosts(Transform):
    """Writes the costs of a step beside its reward, the aggregate `cost` first.

    Args:
        env: The environment, [N].
        config: A complete node: `cost_keys` (entries that are costs), `outside` (ranges), and
            `cost`, a function of a step's TensorDict. It returns one cost [N] or [N, 1], or several
            by name.

    Attributes:
        names: Names of all costs, the aggregate first.

    Raises:
        ConfigError: If there are no costs, or a cost is not one number per row.
    """

    def __init__(self, env: EnvBase, config: Mapping[str, Any]) -> None:
        super().__init__()
        self._entries = {name: entry_key(name) for name in config["cost_keys"]}
        self._ranges = parse_ranges(config["outside"])
        self._function = None if config["cost"] is None else _located(config["cost"])
        if not (self._entries or self._ranges or self._function):
            raise ConfigError(
                "what does a step cost? Name entries (env.cost_keys=[…]), a range "
                "(env.outside='{cost_speed: [thdot, -4, 4]}'), or a function (env.cost)."
            )
        needed = [env.full_state_spec, env.full_action_spec, env.full_done_spec]
        kept = {"reward", *(key for spec in needed for key in spec.keys(True, True))}
        for name, key in self._entries.items():
            if key in kept:
                raise ConfigError(
                    f"env.cost_keys: '{name}' is a state, an action, a reward or an end, and stays "
                    "one. Compute a cost from it by env.outside or env.cost."
                )
        self.names = list(self._costs(env.fake_tensordict()))

    def _costs(self, step: TensorDictBase) -> dict[str, Tensor]:
        """All costs [N, 1] of a step [N] by name."""
        named_costs = [(name.rpartition(".")[2], _entry(step, name)) for name in self._entries]
        for name, kept in self._ranges.items():
            values = _entry(step, kept.entry).reshape(*step.batch_size, -1)
            if kept.column >= values.shape[-1]:
                raise ConfigError(
                    f"'outside': there is no column {kept.column} in {kept.entry}. It has "
                    f"{values.shape[-1]} columns; the first is 0."
                )
            value = values[..., kept.column]
            named_costs.append((name, (value < kept.low) | (value > kept.high)))
        if self._function is not None:
            returned = self._function(step)
            named = returned if isinstance(returned, Mapping) else {COST: returned}
            if wrong := [name for name in named if not is_cost(name)]:
                raise ConfigError(f"env.cost: costs are called cost_<kind>, not '{wrong[0]}'.")
            named_costs += named.items()
        costs: dict[str, Tensor] = {}
        for name, cost in named_costs:
            if name in costs:
                raise ConfigError(
                    f"There are two costs called '{name}': rename one, or choose env.cost_keys=[…]."
                )
            if not isinstance(cost, Tensor) or cost.numel() != step.batch_size.numel():
                shown = list(cost.shape) if isinstance(cost, Tensor) else type(cost).__name__
                raise ConfigError(f"The cost '{name}' must be one number per row, got {shown}.")
            costs[name] = cost.float().reshape(*step.batch_size, 1)
        total = costs.pop(COST) if COST in costs else torch.stack(list(costs.values())).sum(0)
        return {COST: total, **costs}

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        costs = self._costs(tensordict.clone(False).set("next", next_tensordict))
        # where an environment writes some of these flags alone, `SerialEnv` leaves others False
        done, terminated = next_tensordict["done"], next_tensordict["terminated"]
        truncated = next_tensordict.get("truncated", torch.zeros_like(done))
        written = {**costs, "done": done | terminated | truncated}
        written["terminated"] = terminated | (done & ~truncated)
        written["reward"] = next_tensordict["reward"].float()  # transforms would round others
        return next_tensordict.exclude(*self._entries.values()).update(written)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return tensordict_reset.exclude(*self._entries.values())

    def transform_output_spec(self, output_spec: Composite) -> Composite:
        """Add the costs to the reward spec, and remove their entries from where they were."""
        output_spec = super().transform_output_spec(output_spec)
        rewards = output_spec["full_reward_spec"]
        for spec in (output_spec["full_observation_spec"], rewards):
            for key in self._entries.values():
                if key in spec.keys(True):
                    del spec[key]
        highest = dict.fromkeys(self._ranges, 1.0)
        # an entry or a function may have written the aggregate itself
        if not self._entries and self._function is None:
            highest.setdefault(COST, float(len(highest)))
        like: Any = {"device": rewards.device, "dtype": torch.float32}  # not torch's default
        if rewards["reward"].dtype != torch.float32:
            rewards["reward"] = Unbounded(rewards["reward"].shape, **like)
        for name in self.names:
            shape, most = (*rewards.shape, 1), highest.get(name)
            rewards[name] = (
                Unbounded(shape, **like) if most is None else Bounded(0.0, most, shape, **like)
            )
        return output_spec


class CompleteSteps(Transform):
    """Refuses a step that lacks an entry: `SerialEnv` would repeat the one of an earlier step."""

    def __init__(self) -> None:
        super().__init__()
        self._needed: set[NestedKey] | None = None  # reading specs takes longer than a step

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        env = self.container.base_env
        if self._needed is None:
            specs = (env.observation_spec, env.full_reward_spec)
            self._needed = {key for spec in specs for key in spec.keys(True, True)}
        if missing := self._needed.difference(next_tensordict.keys(True, True)):
            raise ConfigError(
                f"{type(env).__name__}: a step wrote no '{dotted(missing.pop())}', which is in its "
                "specs: write it in every step, for example 0 where it costs nothing."
            )
        return next_tensordict


def _located(given: Any) -> Callable[[TensorDictBase], Any]:
    node = dict(given) if isinstance(given, Mapping) else {"_target_": given}
    target = str(node.pop("_target_", None)).replace(":", ".")
    return partial(locate(target, key="env.cost"), **node)


def _entry(step: TensorDictBase, name: str) -> Tensor:
    after = step["next"]
    value = after.get(entry_key(name), None)
    if value is None:
        known = list(map(dotted, after.keys(True, True)))
        raise ConfigError(
            f"There is no entry '{name}'.{did_you_mean(name, known)} A step writes "
            f"{', '.join(known)}. Gymnasium's dictionaries need flatten=False."
        )
    return value


class Observe(Transform):
    """Writes the observed entries into `observation`, which policies read.

    A single entry becomes the observation itself; several become one vector or a dictionary.
    Categorical entries become one-hot, and those of several choices (MultiDiscrete) floats;
    pictures stay as they are.

    Args:
        env: The environment, [N].
        config: A complete node: `observe`, names of entries (None takes `observation`, or without
            such an entry all that are not nested), and `flatten`, whether several entries become
            one vector.

    Attributes:
        layout: Columns of every entry in one vector. `a.b` is called b, or a_b if two end in b.
    """

    def __init__(self, env: EnvBase, config: Mapping[str, Any]) -> None:
        super().__init__()
        name, spec = config.get("privileged"), env.observation_spec
        self._specs = _choose_entries(spec, config["observe"], name)
        self._privileged = {} if name is None else {name: spec[entry_key(name)]}
        if any(map(_is_picture, self._privileged.values())):
            raise ConfigError(f"env.privileged={name}: it is a picture, and critics read a vector.")
        self.privileged_layout = add_columns({}, {n: _size(s) for n, s in self._privileged.items()})
        self._flatten = config["flatten"] and len(self._specs) > 1
        pictures = [name for name, spec in self._specs.items() if _is_picture(spec)]
        if self._flatten and pictures:
            raise ConfigError(
                f"{', '.join(pictures)}: pictures cannot be part of a vector. Use env.flatten=false"
                " for a dictionary (model=cnn or model=dict), or leave them out: env.observe=[…]."
            )
        # what the environment needs for its next step stays where it is
        needed = {*map(dotted, env.state_spec.keys(True, True)), _OBSERVATION}
        self._moved = [entry_key(n) for n in (*self._specs, *self._privileged) if n not in needed]
        last = [name.rpartition(".")[2] for name in self._specs]
        self._names = {
            name: name.replace(".", "_") if last.count(end) > 1 else end
            for name, end in zip(self._specs, last, strict=True)
        }
        self.layout = add_columns({}, {self._names[n]: _size(s) for n, s in self._specs.items()})

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        values = {
            self._names[name]: _numbers(next_tensordict[entry_key(name)], spec)
            for name, spec in self._specs.items()
        }
        after = next_tensordict.exclude(*self._moved)
        for name, spec in self._privileged.items():
            after.set(_PRIVILEGED, _numbers(next_tensordict[entry_key(name)], spec))
        if self._flatten:
            return after.set(_OBSERVATION, torch.cat(list(values.values()), -1))
        if len(values) == 1:
            return after.set(_OBSERVATION, next(iter(values.values())))
        return after.set(_OBSERVATION, after.empty().update(values))

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self._call(tensordict_reset)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add `observation`, and remove the entries that are moved there."""
        shape, device = observation_spec.shape, observation_spec.device
        vector = partial(Unbounded, device=device, dtype=torch.float32)
        parts = {
            self._names[name]: spec if _is_picture(spec) else vector((*shape, _size(spec)))
            for name, spec in self._specs.items()
        }
        for key in self._moved:
            if key in observation_spec.keys(True):
                del observation_spec[key]
        for spec in self._privileged.values():
            observation_spec[_PRIVILEGED] = vector((*shape, _size(spec)))
        if self._flatten:
            size = sum(map(_size, self._specs.values()))
            observation_spec[_OBSERVATION] = vector((*shape, size))
        elif len(parts) == 1:
            observation_spec[_OBSERVATION] = next(iter(parts.values()))
        else:
            observation_spec[_OBSERVATION] = Composite(parts, shape=shape, device=device)
        return observation_spec


def _choose_entries(
    spec: Composite, wanted: list[str] | None, privileged: str | None
) -> dict[str, TensorSpec]:
    """Return the specs of the observed entries, without the privileged one, by dotted names."""
    known = {
        dotted(key): part
        for key, part in spec.items(True, True)
        if not isinstance(part, Composite | NonTensor)
    }
    named = [("observe", name) for name in wanted or ()]
    for key, name in named if privileged is None else [*named, ("privileged", privileged)]:
        if name not in known:
            raise ConfigError(
                f"env.{key}: there is no entry '{name}'.{did_you_mean(name, known)} There are "
                f"{', '.join(known)}."
            )
    if privileged is not None and privileged not in (wanted or ()):
        del known[privileged]
    below = [name for name in known if name.partition(".")[0] == _OBSERVATION]
    chosen = wanted or below or [name for name in known if "." not in name]
    if not chosen:
        raise ConfigError(f"env.observe: choose among {', '.join(known) or 'no entries at all'}.")
    return {name: known[name] for name in chosen}


def _is_picture(spec: TensorSpec) -> bool:
    """Whether a spec has four dimensions: N, and height, width and colours in any order."""
    return len(spec.shape) == 4


def _choices(spec: TensorSpec) -> int | None:
    """Number of choices of a categorical entry; None for any other."""
    is_kind = isinstance(spec, Categorical) and not isinstance(spec, Binary | MultiCategorical)
    return int(spec.space.n) if is_kind and spec.dtype != torch.bool else None


def _size(spec: TensorSpec) -> int:
    """Number of columns of an entry in a vector."""
    return spec.shape[1:].numel() * (_choices(spec) or 1)


def _numbers(value: Tensor, spec: TensorSpec) -> Tensor:
    """Return a picture as it is, anything else as float32 [N, n]."""
    if _is_picture(spec):
        return value
    choices = _choices(spec)
    value = value if choices is None else one_hot(value, choices)
    return value.reshape(spec.shape[0], -1).float()
