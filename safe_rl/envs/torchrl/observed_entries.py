"""What is observed of entries of any shape: a vector, a picture, or a dictionary of both."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import accumulate

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.nn.functional import one_hot
from torchrl.data import Binary, Categorical, Composite, NonTensor, TensorSpec, Unbounded
from torchrl.envs.transforms import Transform

from safe_rl.envs.errors import ConfigError, nearest
from safe_rl.envs.torchrl.step_costs import dotted, entry_key

__all__ = ["Observe", "choose_entries"]

_OBSERVATION = "observation"


def choose_entries(spec: Composite, wanted: Sequence[str] | None) -> dict[str, TensorSpec]:
    """Return entries that are observed, by name, with dots where they are nested.

    Args:
        spec: Of what an environment of batch size [N] observes.
        wanted: Names; None takes `observation`, or where there is none all that is not nested.

    Raises:
        ConfigError: For a name that there is not, or if there are no numbers to observe.

    Examples:
        >>> params = Composite(g=Unbounded(4), shape=[4])
        >>> spec = Composite(th=Unbounded(4), params=params, shape=[4])
        >>> list(choose_entries(spec, None)), list(choose_entries(spec, ["params.g"]))
        (['th'], ['params.g'])
    """
    known = {
        dotted(key): part
        for key, part in spec.items(True, True)
        if not isinstance(part, Composite | NonTensor)
    }
    for name in wanted or ():
        if name not in known:
            raise ConfigError(
                f"env.observe: there is no entry '{name}'.{nearest(name, known)} There are "
                f"{', '.join(known)}."
            )
    if wanted:
        return {name: known[name] for name in wanted}
    below = [name for name in known if name.partition(".")[0] == _OBSERVATION]
    chosen = below or [name for name in known if "." not in name]
    if not chosen:
        raise ConfigError(f"env.observe: name what is observed, of {', '.join(known) or 'nothing'}")
    return {name: known[name] for name in chosen}


class Observe(Transform):
    """Puts chosen entries where policies look for them: `observation`.

    One entry is the observation itself; several become one vector, or a dictionary. Kinds become
    one-hot, pictures stay as they are.

    Args:
        entries: Name -> spec of N environments, as `choose_entries` returns them.
        flatten: Make one vector of several.
        kept: Names of entries that the environment needs for its next step.

    Raises:
        ConfigError: If pictures are to be flattened.
    """

    def __init__(
        self, entries: Mapping[str, TensorSpec], flatten: bool, kept: Iterable[str]
    ) -> None:
        super().__init__()
        needed = set(kept)
        pictures = [name for name, spec in entries.items() if _is_picture(spec)]
        if flatten and pictures and len(entries) > 1:
            raise ConfigError(
                f"{', '.join(pictures)}: pictures are no part of a vector. env.flatten=false makes "
                "a dictionary, for model=cnn or model=dict; env.observe=[…] leaves some out."
            )
        self._specs = dict(entries)
        self._flatten = flatten
        self._moved = [entry_key(n) for n in entries if n not in needed and n != _OBSERVATION]

    @property
    def layout(self) -> dict[str, slice]:
        """Columns of every entry, as if all of them were one vector."""
        ends = list(accumulate(map(_size, self._specs.values())))
        return {
            name.rpartition(".")[2]: slice(end - _size(spec), end)
            for (name, spec), end in zip(self._specs.items(), ends, strict=True)
        }

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        values = {
            name: _numbers(next_tensordict[entry_key(name)], spec)
            for name, spec in self._specs.items()
        }
        after = next_tensordict.exclude(*self._moved)
        if len(values) == 1:
            return after.set(_OBSERVATION, next(iter(values.values())))
        if self._flatten:
            return after.set(_OBSERVATION, torch.cat(list(values.values()), -1))
        entries = {name.rpartition(".")[2]: value for name, value in values.items()}
        return after.set(_OBSERVATION, after.empty().update(entries))

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self._call(tensordict_reset)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Describe what is written, and leave out what is moved."""
        shape, device = observation_spec.shape, observation_spec.device
        parts = {
            name.rpartition(".")[2]: spec
            if _is_picture(spec)
            else Unbounded((*shape, _size(spec)), device=device)
            for name, spec in self._specs.items()
        }
        for key in self._moved:
            if key in observation_spec.keys(True):
                del observation_spec[key]
        if len(parts) == 1:
            observation_spec[_OBSERVATION] = next(iter(parts.values()))
        elif self._flatten:
            size = sum(map(_size, self._specs.values()))
            observation_spec[_OBSERVATION] = Unbounded((*shape, size), device=device)
        else:
            observation_spec[_OBSERVATION] = Composite(parts, shape=shape, device=device)
        return observation_spec


def _is_picture(spec: TensorSpec) -> bool:
    """Of N environments, height, width and colours in some order."""
    return len(spec.shape) == 4


def _is_kind(spec: TensorSpec) -> bool:
    return isinstance(spec, Categorical) and not isinstance(spec, Binary)


def _size(spec: TensorSpec) -> int:
    """Numbers of one environment."""
    choices = spec.space.n if _is_kind(spec) and spec.dtype != torch.bool else 1
    return spec.shape[1:].numel() * int(choices)


def _numbers(value: Tensor, spec: TensorSpec) -> Tensor:
    """A picture as it is, anything else as float32 [N, n]."""
    if _is_picture(spec):
        return value
    if _is_kind(spec) and spec.dtype != torch.bool:
        value = one_hot(value, int(spec.space.n))
    return value.reshape(spec.shape[0], -1).float()
