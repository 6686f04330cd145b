"""Build networks from a configuration's node ``model`` and an environment's specs.

Encoders read observations (vectors, pictures or several of both); a layer may be recurrent.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torchrl.data import Bounded, Composite, TensorSpec
from torchrl.modules import ConvNet, GRUModule, set_recurrent_mode

from safe_rl.models.heads import AUTO, Head, make_head
from safe_rl.models.networks import (
    Chain,
    InputScale,
    RunningScale,
    Tanh,
    assemble_actor,
    input_scale_vector,
    perceptron,
)


class Entry(NamedTuple):
    """A tensor that is observed."""

    key: NestedKey
    name: str  # of the component; "observation" if the observation is not nested
    shape: tuple[int, ...]  # of one environment: [n], [height, width, colours] or colours first
    highest: float  # the largest number of a picture of integers, 255 at most; else 1

    def __str__(self) -> str:
        return f"{self.name} {list(self.shape)}"


def observed_entries(spec: Composite, names: Sequence[str] = ("observation",)) -> list[Entry]:
    """Return the entries with these names; those of a dictionary in alphabetical order.

    Raises:
        ValueError: If an entry is not written, or neither a vector nor a picture.
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
    if len(shape := tuple(spec.shape[1:])) not in (1, 3):
        raise ValueError(
            f"The observation '{name}' of an environment has the shape {list(shape)}, but networks "
            "take vectors [n] and pictures [height, width, colours]."
        )
    most = float(spec.high.max()) if isinstance(spec, Bounded) else 255.0
    is_of_integers = not (spec.dtype.is_floating_point or spec.dtype == torch.bool)
    return Entry(key, name, shape, min(max(most, 1.0), 255.0) if is_of_integers else 1.0)


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
        ValueError: If dictionaries or pictures have no encoder, or encoders of pictures no picture.
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
            f"This environment observes {', '.join(map(str, entries))}, but model=mlp and "
            f"model=gru take one vector: use {advice}, or make the environment flatten them: with "
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
    """Encode every entry, and run a perceptron on the codes and on ``extra`` further inputs."""

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
    """Converts pictures with colours last or first, in [0, highest], for convolutions."""

    def __init__(self, colours_last: bool, highest: float) -> None:
        super().__init__()
        self._colours_last, self._factor = colours_last, 1 / highest

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
    assert observed.encoders is not None
    names = ("channels", "kernels", "strides")
    channels, kernels, strides = (list(observed.encoders[name]) for name in names)
    first, middle, last = entry.shape
    # colours are the shorter end, or the last one with at most three colours and a depth
    colours_last = last <= 4 or (middle != last and (first == middle or last < first))
    convolutions = ConvNet(
        in_features=last if colours_last else first,
        num_cells=channels,
        kernel_sizes=kernels,
        strides=strides,
        activation_class=nn.ReLU,
        device=device,
    )
    network = nn.Sequential(Pixels(colours_last, entry.highest), convolutions)
    try:
        network(_blank(entry, device))
    except RuntimeError as error:
        raise ValueError(
            f"The picture '{entry.name}' of shape {list(entry.shape)} is too small for "
            f"model.encoders.kernels={kernels} with the strides {strides}: choose smaller ones."
        ) from error
    return network


def _blank(entry: Entry, device: torch.device | None) -> Tensor:
    return torch.zeros(1, *entry.shape, device=device)


FEATURES, RECURRENT, FIRST = "features", "memory", "is_init"


class RecurrentLayer(TensorDictModuleBase):
    """Gated recurrent units (Cho et al. 2014) between the features of a network.

    A batch [N] is a step of N environments: the new state is written to ``("next", "memory")``, and
    is an input of the next step. A batch [N, T] contains sequences in order of time: the state of
    the first step is read, and it is 0 wherever ``is_init`` is True. Outputs have the `size` of the
    state.
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


def build_networks(
    model: Mapping[str, Any],
    observation_spec: Composite,
    action_spec: TensorSpec,
    layout: Mapping[str, slice],
    *,
    num_costs: int,
    device: torch.device,
    privileged_layout: Mapping[str, slice] | None = None,
) -> dict[str, Any]:
    """Build an actor, a reward critic and, for ``num_costs`` > 0, a cost critic.

    They share no weights. Critics are not recurrent; with a recurrent actor, its state is one of
    their inputs.

    Args:
        model: Node ``model`` of a configuration as composed from ``conf/``.
        observation_spec: That of N environments.
        action_spec: That of N environments.
        layout: Component -> columns of the flat observation.
        num_costs: Outputs of the cost critic.
        device: Device of all parameters.
        privileged_layout: Component -> columns of the entry ``privileged``.

    Raises:
        ValueError: If the configuration does not fit the environment.
    """
    layouts = {"observation": layout, "privileged": privileged_layout or {}}
    observed = observed_by(model, observation_spec, layouts)
    read = model.get("critic_observes") or ["observation"]
    seen = observed._replace(entries=observed_entries(observation_spec, read))
    widths = list(model["hidden_sizes"])
    recurrent_size = model["memory"]["size"] if model.get("memory") else 0
    if recurrent_size and RECURRENT not in observation_spec.keys():  # noqa: SIM118, a spec is no mapping
        raise ValueError(
            "A recurrent policy needs the transform that keeps its state between steps: choose "
            "model=gru instead of setting model.memory alone."
        )
    kind, log_std = model.get("head") or AUTO, model["initial_log_std"]
    head = make_head(kind, action_spec, initial_log_std=log_std, device=device)
    actor = _actor(observed, head, widths, recurrent_size, device)

    def critic(num_outputs: int, out_key: str) -> TensorDictModule:
        body = _body(seen, num_outputs, widths, recurrent_size, device)
        in_keys = [*seen.keys, RECURRENT] if recurrent_size else seen.keys
        return TensorDictModule(body, in_keys=in_keys, out_keys=[out_key])

    networks: dict[str, Any] = {"actor": actor, "critic": critic(1, "state_value")}
    if num_costs:
        networks["cost_critic"] = critic(num_costs, "cost_value")
    return networks


def _actor(
    observed: Observed, head: Head, widths: Sequence[int], recurrent_size: int, device: torch.device
) -> ProbabilisticTensorDictSequential:
    """Hidden layers and a head; a recurrent layer between them if ``recurrent_size`` is not 0."""
    if not recurrent_size:
        body = _body(observed, head.num_outputs, widths, 0, device)
        return assemble_actor(body, head, in_keys=observed.keys)
    if not widths:
        raise ValueError(
            "model.hidden_sizes=[]: a recurrent policy needs at least one hidden layer."
        )
    encoder = Chain(_body(observed, widths[-1], widths[:-1], 0, device), Tanh())
    before: list[TensorDictModuleBase] = [
        TensorDictModule(encoder, in_keys=observed.keys, out_keys=[FEATURES]),
        RecurrentLayer(widths[-1], recurrent_size, device=device),
    ]
    body = perceptron(recurrent_size, head.num_outputs, [], None, device)
    return assemble_actor(body, head, in_keys=[FEATURES], before=before)


def _body(
    observed: Observed,
    num_outputs: int,
    widths: Sequence[int],
    recurrent_size: int,
    device: torch.device,
) -> nn.Module:
    """From observations and the recurrent state to outputs; a plain perceptron where possible."""
    first = observed.entries[0]
    if observed.encoders is not None or recurrent_size or len(observed.entries) > 1:
        plain = observed._replace(encoders=observed.encoders or {"vector": []})
        return Body(plain, num_outputs, widths, extra=recurrent_size, device=device)
    size = first.shape[0]
    if observed.clip is None:
        return perceptron(size, num_outputs, widths, observed.scale(first), device)
    running = RunningScale(size, key=first.key, clip=observed.clip, device=device)
    return nn.Sequential(running, *perceptron(size, num_outputs, widths, None, device))
