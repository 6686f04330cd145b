"""Encoders of observations (vectors, pictures or several of both), and the recurrent layer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.data import Composite, TensorSpec
from torchrl.modules import ConvNet, GRUModule, set_recurrent_mode

from safe_rl.models.networks import InputScale, RunningScale, Tanh, input_scale_vector, perceptron


class Entry(NamedTuple):
    """A tensor that is observed."""

    key: NestedKey
    name: str  # of the component; "observation" if the observation is not nested
    shape: tuple[int, ...]  # of one environment: [n], [height, width, colours] or colours first
    is_bytes: bool  # whether the numbers are integers from 0 to 255

    def __str__(self) -> str:
        return f"{self.name} {list(self.shape)}"


def observed_entries(spec: Composite, names: Sequence[str] = ("observation",)) -> list[Entry]:
    """Return the entries with these names; those of a dictionary in alphabetical order.

    Raises:
        ValueError: If the environment does not write an entry, or it is neither a vector nor a
            picture.
    """
    entries: list[Entry] = []
    for name in names:
        if name not in spec.keys():  # noqa: SIM118, a spec is no mapping
            raise ValueError(
                f"model.critic_observes: this environment writes no '{name}'. Set "
                "env.observe_privileged=true in Safety Gym, or name an entry with env=gymnasium "
                "and env=torchrl: env.privileged=…"
            )
        if isinstance(spec[name], Composite):
            below = sorted(map(str, spec[name].keys()))
            entries += [_entry((name, part), part, spec[name][part]) for part in below]
        else:
            entries.append(_entry(name, name, spec[name]))
    return entries


def _entry(key: NestedKey, name: str, spec: TensorSpec) -> Entry:
    shape = tuple(spec.shape[1:])
    if len(shape) not in (1, 3):
        raise ValueError(
            f"The observation '{name}' of an environment has the shape {list(shape)}, but networks "
            "take vectors [n] and pictures [height, width, colours]."
        )
    return Entry(key, name, shape, not spec.dtype.is_floating_point)


class Observed(NamedTuple):
    """Properties of observations that networks depend on."""

    entries: Sequence[Entry]
    # key of a vector with several components -> component -> its columns
    layouts: Mapping[str, Mapping[str, slice]]
    input_scale: Mapping[str, float]  # component -> factor
    clip: float | None  # bound of columns normalised by running moments; None: not normalised
    encoders: Mapping[str, Any] | None  # settings of each entry's encoder; None for one vector

    @property
    def keys(self) -> list[NestedKey]:
        """Keys of the entries."""
        return [entry.key for entry in self.entries]

    def scale(self, entry: Entry) -> Tensor | None:
        """Factors [n] of the columns of a vector; None if all are 1."""
        # an entry of a dictionary may have the name "observation", too
        layout = self.layouts.get(entry.key) if isinstance(entry.key, str) else None
        layout = layout or {entry.name: slice(0, entry.shape[0])}
        return input_scale_vector(self.input_scale, layout, entry.shape[0])

    def scales(self) -> Tensor | None:
        """Factors of the columns of all entries, which are vectors; None if all are 1."""
        factors = [self.scale(entry) for entry in self.entries]
        if all(scale is None for scale in factors):
            return None
        sizes = [entry.shape[0] for entry in self.entries]
        parts = zip(factors, sizes, strict=True)
        return torch.cat([torch.ones(n) if scale is None else scale for scale, n in parts])


def observed_by(
    model: Mapping[str, Any], spec: Composite, layouts: Mapping[str, Mapping[str, slice]]
) -> Observed:
    """What a policy observes, from a configuration's node ``model`` and the observation's spec.

    Raises:
        ValueError: If dictionaries or pictures have no encoder, or encoders of pictures no picture;
            the message has the ``model`` to choose.
    """
    entries, encoders = observed_entries(spec), model.get("encoders")
    is_vector = len(entries) == 1 and len(entries[0].shape) == 1
    if encoders is not None and not encoders["vector"] and is_vector:
        raise ValueError(
            "model=cnn encodes pictures, and this environment observes only a vector. Use "
            "model=mlp, or an environment with pictures, such as env=PointGoal1Vision."
        )
    if encoders is None and not is_vector:
        pictures = any(len(entry.shape) == 3 for entry in entries)
        advice = "model=cnn for the pictures" if pictures else "model=dict, an encoder for each"
        raise ValueError(
            f"This environment observes {', '.join(map(str, entries))}, but model=mlp takes one "
            f"vector: use {advice}, or make the environment flatten them: with "
            "env.observation_flatten=true in Safety Gym, else with env.flatten=true."
        )
    return Observed(entries, layouts, model["input_scale"], model.get("normalise"), encoders)


class Codes(nn.Module):
    """Encode every entry, and concatenate the codes, ``size`` in all."""

    def __init__(self, observed: Observed, device: torch.device | None = None) -> None:
        super().__init__()
        self.encoders, self.size = nn.ModuleList(), 0
        for entry in observed.entries:
            encoder = (_vector if len(entry.shape) == 1 else _picture)(entry, observed, device)
            self.encoders.append(encoder)
            self.size += encoder(_blank(entry, device)).shape[-1]

    def forward(self, *inputs: Tensor) -> Tensor:
        """Entries [..., n] or [..., height, width, colours] -> [..., size]."""
        return torch.cat([encode(x) for encode, x in zip(self.encoders, inputs, strict=True)], -1)


class Body(Codes):
    """Encode every entry, concatenate the codes, and run a perceptron on them.

    A number of ``extra`` inputs follow the entries, and are not encoded.
    """

    def __init__(
        self,
        observed: Observed,
        out_features: int,
        hidden_sizes: Sequence[int],
        *,
        extra: int = 0,
        device: torch.device | None = None,
    ) -> None:
        super().__init__(observed, device)
        self.perceptron = perceptron(self.size + extra, out_features, hidden_sizes, None, device)

    def forward(self, *inputs: Tensor) -> Tensor:
        """Entries [..., n] or [..., height, width, colours] -> [..., out_features]."""
        number = len(self.encoders)
        codes = super().forward(*inputs[:number])
        return self.perceptron(torch.cat([codes, *inputs[number:]], -1))


class Pixels(nn.Module):
    """Converts pictures with colours last or first, in bytes or [0, 1], for convolutions."""

    def __init__(self, colours_last: bool, is_bytes: bool) -> None:
        super().__init__()
        self._colours_last, self._factor = colours_last, 1 / 255 if is_bytes else 1.0

    def forward(self, picture: Tensor) -> Tensor:
        """[..., height, width, colours] -> [..., colours, height, width], float."""
        picture = picture.movedim(-1, -3) if self._colours_last else picture
        return picture.float() * self._factor


def _vector(entry: Entry, observed: Observed, device: torch.device | None) -> nn.Module:
    size, widths = entry.shape[0], list(observed.encoders["vector"])  # type: ignore[index]
    scale = observed.scale(entry)
    layers: list[nn.Module] = []
    if observed.clip is not None:  # normalisation makes input scales unnecessary
        layers.append(RunningScale(size, key=entry.key, clip=observed.clip, device=device))
    elif scale is not None:
        layers.append(InputScale(scale.to(device)))
    for before, width in zip([size, *widths], widths, strict=False):
        layers += [*perceptron(before, width, [], None, device), Tanh()]
    return nn.Sequential(*layers)


def _picture(entry: Entry, observed: Observed, device: torch.device | None) -> nn.Module:
    settings = observed.encoders
    assert settings is not None
    # at most three colours and a depth; if both ends are that short, colours are last
    colours_last = entry.shape[-1] <= 4
    colours = entry.shape[-1] if colours_last else entry.shape[0]
    convolutions = ConvNet(
        in_features=colours,
        num_cells=list(settings["channels"]),
        kernel_sizes=list(settings["kernels"]),
        strides=list(settings["strides"]),
        activation_class=nn.ReLU,
        device=device,
    )
    network = nn.Sequential(Pixels(colours_last, entry.is_bytes), convolutions)
    try:
        network(_blank(entry, device))
    except RuntimeError as error:
        raise ValueError(
            f"The picture '{entry.name}' of shape {list(entry.shape)} is too small for "
            f"model.encoders.kernels={list(settings['kernels'])} with the strides "
            f"{list(settings['strides'])}: choose smaller ones."
        ) from error
    return network


def _blank(entry: Entry, device: torch.device | None) -> Tensor:
    return torch.zeros(1, *entry.shape, device=device)


FEATURES, RECURRENT, FIRST = "features", "memory", "is_init"


class RecurrentLayer(TensorDictModuleBase):
    """Gated recurrent units (Cho et al. 2014) between the features of a network.

    A batch [N] is a step of N environments: the new state is written to ``("next", "memory")``, and
    is an input of the next step. A batch [N, T] contains sequences in order of time: the state of
    the first step is read, and it is 0 wherever ``is_init`` is True.

    Args:
        num_features: Number of inputs.
        size: Size of the state, and number of outputs.
        device: Device of the parameters.
    """

    def __init__(self, num_features: int, size: int, *, device: torch.device | None = None) -> None:
        super().__init__()
        self.in_keys = [FEATURES, RECURRENT, FIRST]
        self.out_keys = [FEATURES, ("next", RECURRENT)]
        self.recurrent = GRUModule(
            num_features, size, in_keys=self.in_keys, out_keys=self.out_keys, device=device
        )

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Replace the features; after a single step also write the new state."""
        inputs = {key: tensordict.get(key) for key in self.in_keys}
        inputs[RECURRENT] = inputs[RECURRENT].unsqueeze(-2)  # the dimension of layers
        steps = TensorDict(inputs, batch_size=tensordict.batch_size)
        is_sequence = tensordict.ndim > 1
        with set_recurrent_mode(is_sequence):
            self.recurrent(steps)
        tensordict.set(FEATURES, steps.get(FEATURES))
        if not is_sequence:
            tensordict.set(("next", RECURRENT), steps.get(("next", RECURRENT)).squeeze(-2))
        return tensordict
