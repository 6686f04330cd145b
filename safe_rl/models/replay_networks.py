"""Networks of off-policy algorithms: actors with bounded actions (SAC, TD3), Q functions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any, TypeAlias

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torch.func import functional_call
from torch.nn.functional import softplus
from torchrl.data import Bounded, TensorSpec
from torchrl.envs import EnvBase
from torchrl.modules import MLP, NormalParamExtractor, TanhNormal

from safe_rl.models.heads import action_sampler
from safe_rl.models.networks import Chain, InputScale

_SCALE_FLOOR = 1e-3
Shape: TypeAlias = torch.Size | list[int] | tuple[int, ...]


def _perceptron(
    sizes: tuple[int, int],
    hidden_sizes: Sequence[int],
    input_scale: Tensor | None,
    device: torch.device | None,
    encoder: nn.Module | None,
) -> list[nn.Module]:
    perceptron = MLP(
        *sizes,
        num_cells=list(hidden_sizes),
        activation_class=nn.ReLU,
        activation_kwargs={"inplace": True},
        device=device,
    )
    scaling = [] if input_scale is None else [InputScale(input_scale.to(device))]
    return [*scaling, *([] if encoder is None else [encoder]), perceptron]


def _action_size(low: Tensor) -> int:
    if low.ndim != 1:
        raise ValueError(
            f"The bounds have the shape {list(low.shape)}, and must be those of one action, [A]: "
            "env.action_spec_unbatched has them."
        )
    return len(low)


def make_squashed_actor(
    observation_size: int,
    low: Tensor,
    high: Tensor,
    *,
    hidden_sizes: Sequence[int],
    input_scale: Tensor | None = None,
    device: torch.device | None = None,
    encoder: nn.Module | None = None,
    in_keys: Sequence[NestedKey] = ("observation",),
) -> ProbabilisticTensorDictSequential:
    """Build a policy whose actions are the tanh of a Gaussian, within bounds (SAC's).

    Args:
        observation_size: Length of the flat observation, or of the encoder's outputs.
        low: Lower bounds of the action, [A].
        high: Upper bounds of the action, [A].
        hidden_sizes: Width of every hidden layer.
        input_scale: Fixed factors of the observation, or None.
        device: Device of the parameters.
        encoder: Module before the perceptron, which takes the entries `in_keys`, scaled by
            `input_scale`.
        in_keys: Keys of the observation.

    Examples:
        >>> make_squashed_actor(3, -torch.ones(2), torch.ones(2), hidden_sizes=[8]).out_keys
        ['loc', 'scale', 'action', 'action_log_prob']
    """
    sizes = (observation_size, 2 * _action_size(low))
    layers = _perceptron(sizes, hidden_sizes, input_scale, device, encoder)
    extractor = NormalParamExtractor("biased_softplus_1.0", scale_lb=_SCALE_FLOOR)
    network = Chain(*layers, extractor)
    return _SquashedActor(
        TensorDictModule(network, in_keys=list(in_keys), out_keys=["loc", "scale"]),
        action_sampler(("loc", "scale"), SquashedNormal, low=low.to(device), high=high.to(device)),
    )


def make_bounded_actor(
    observation_size: int,
    low: Tensor,
    high: Tensor,
    *,
    hidden_sizes: Sequence[int],
    input_scale: Tensor | None = None,
    device: torch.device | None = None,
    encoder: nn.Module | None = None,
    in_keys: Sequence[NestedKey] = ("observation",),
) -> TensorDictModule:
    """Build a deterministic policy whose actions are the tanh of a network, within bounds (TD3's).

    Arguments are those of `make_squashed_actor`.

    Examples:
        >>> make_bounded_actor(3, torch.zeros(1), torch.ones(1), hidden_sizes=[8]).out_keys
        ['action']
    """
    sizes = (observation_size, _action_size(low))
    layers = _perceptron(sizes, hidden_sizes, input_scale, device, encoder)
    network = Chain(*layers, _Squash(low, high, device))
    return TensorDictModule(network, in_keys=list(in_keys), out_keys=["action"])


class SquashedNormal(TanhNormal):
    """A `TanhNormal` that is built when a method other than `rsample_and_log_prob` is called.

    Soft actor-critics only call this method, twice per update. Building the transforms and checking
    the bounds takes six times as long. ``loc`` and ``scale``, [..., A], are those before the tanh;
    the bounds are [A].
    """

    def __init__(self, loc: Tensor, scale: Tensor, low: Tensor, high: Tensor) -> None:
        self.__dict__["_given"] = {"loc": loc, "scale": scale, "low": low, "high": high}

    def __getattr__(self, name: str) -> Any:
        given = self.__dict__.get("_given")
        # with "_t", TorchRL's constructor is running or done: there is no such attribute
        if given is None or "_t" in self.__dict__ or name.startswith("__"):
            raise AttributeError(f"'{type(self).__name__}' has no attribute '{name}'")
        super().__init__(**given)
        return getattr(self, name)

    def rsample_and_log_prob(self, sample_shape: Shape = torch.Size()) -> tuple[Tensor, Tensor]:  # noqa: B008
        """Draw actions [..., A], differentiably, and compute their log-densities [...]."""
        loc, scale, low, high = self.__dict__["_given"].values()
        noise = torch.randn(*sample_shape, *loc.shape, dtype=loc.dtype, device=loc.device)
        inner, half = torch.addcmul(loc, scale, noise), (high - low) / 2
        # log of the tanh's slope, without its rounding where it is flat
        slope = 2 * (math.log(2) - inner - softplus(-2 * inner))
        density = -0.5 * noise.square() - scale.log() - 0.5 * math.log(2 * math.pi)
        log_prob = (density - slope - half.log()).sum(-1)
        return low + half * (1 + inner.tanh()), log_prob


class _SquashedActor(ProbabilisticTensorDictSequential):
    """A sequence of two modules that makes its distribution in a third of the usual time."""

    def get_dist(
        self,
        tensordict: TensorDictBase,
        tensordict_out: TensorDictBase | None = None,
        **kwargs: Any,
    ) -> SquashedNormal:
        parameters, head = self
        loc, scale = parameters.module(*map(tensordict.get, parameters.in_keys))
        return SquashedNormal(loc, scale, **head.distribution_kwargs)


class _Squash(nn.Module):
    """The tanh of the input, scaled to bounds."""

    low: Tensor
    reach: Tensor

    def __init__(self, low: Tensor, high: Tensor, device: torch.device | None) -> None:
        super().__init__()
        self.register_buffer("low", low.to(device), persistent=False)
        self.register_buffer("reach", (high - low).to(device) / 2, persistent=False)

    def forward(self, inputs: Tensor) -> Tensor:
        return self.low + self.reach * (1 + inputs.tanh())


def bounded_actions(env: EnvBase) -> TensorSpec:
    """Spec of one environment's bounded action, [A], in single precision like the networks.

    Raises:
        ValueError: If actions are not vectors [A] of continuous numbers within finite bounds.
    """
    spec = env.action_spec_unbatched
    is_continuous = isinstance(spec, Bounded) and spec.dtype.is_floating_point
    if not is_continuous or not (spec.low.isfinite() & spec.high.isfinite()).all():
        raise ValueError(
            "Off-policy algorithms need continuous actions within bounds, and this environment's "
            f"action_spec is {type(spec).__name__}. Use an on-policy one such as ppo_lagrangian."
        )
    if len(spec.shape) != 1:
        raise ValueError(
            f"An action of this environment has the shape {list(spec.shape)}: policies act by "
            "vectors [A]. Let the environment take them, and give them their shape itself."
        )
    return spec.to(torch.float32)


Layers = Sequence[tuple[Tensor, Tensor]]


class EnsembleMLP(nn.Module):
    """E ReLU perceptrons that are evaluated together by one batched matrix product per layer.

    Its overhead is a fraction of that of `torch.func.vmap` over modules.

    Args:
        num_networks: E.
        sizes: Numbers of inputs, of units of every hidden layer, and of outputs.
        device: Device of the parameters.

    Examples:
        >>> EnsembleMLP(2, [3, 8, 1])(torch.zeros(5, 3)).shape
        torch.Size([2, 5, 1])
    """

    def __init__(
        self, num_networks: int, sizes: Sequence[int], device: torch.device | None = None
    ) -> None:
        super().__init__()
        self.num_networks = num_networks
        self.weights, self.biases = nn.ParameterList(), nn.ParameterList()
        for fan_in, fan_out in pairwise(sizes):
            # the initial weights of torch.nn.Linear
            bound = fan_in**-0.5
            for rows, parameters in ((fan_in, self.weights), (1, self.biases)):
                values = torch.empty(num_networks, rows, fan_out, device=device)
                parameters.append(nn.Parameter(values.uniform_(-bound, bound)))

    def forward(self, inputs: Tensor, layers: Layers | None = None) -> Tensor:
        """Outputs [E, …, n] of all networks for inputs […, m], with own or given `layers`."""
        hidden = inputs.reshape(-1, inputs.shape[-1]).expand(self.num_networks, -1, -1)
        for number, (weight, bias) in enumerate(self.layers() if layers is None else layers):
            # in place, because the backward pass of a ReLU needs only its output
            hidden = torch.baddbmm(bias, hidden.relu_() if number else hidden, weight)
        return hidden.reshape(self.num_networks, *inputs.shape[:-1], hidden.shape[-1])

    def layers(self, params: TensorDictBase | None = None) -> Layers:
        """Weights [E, m, n] and biases [E, 1, n] of every layer, own ones or from `params`."""
        if params is None:
            return list(zip(self.weights, self.biases, strict=True))
        names = map(str, range(len(self.weights)))
        return [(params["weights", name], params["biases", name]) for name in names]


class QEnsemble(TensorDictModuleBase):
    """E Q functions of observation and action as one module, without vmap.

    Args:
        observation_size: Length of the flat observation, or of all entries before the action
            together.
        action_size: Length of the action.
        hidden_sizes: Width of every hidden layer.
        num_networks: E.
        num_outputs: Values per network: 1 for the reward, K for K costs.
        input_scale: Fixed factors of these entries, or None.
        device: Device of the parameters.
        encoder: Module from these entries to the `observation_size` inputs of all networks, which
            share it; None: the entries side by side.
        in_keys: Keys of the observation (and of further entries that critics read) and the action.
        out_key: Key of the values.

    Examples:
        >>> q = QEnsemble(3, 2, hidden_sizes=[8], num_networks=2)
        >>> steps = TensorDict(observation=torch.zeros(5, 3), action=torch.zeros(5, 2))
        >>> q(steps.auto_batch_size_(1))["state_action_value"].shape
        torch.Size([2, 5, 1])
    """

    def __init__(
        self,
        observation_size: int,
        action_size: int,
        *,
        hidden_sizes: Sequence[int],
        num_networks: int,
        num_outputs: int = 1,
        input_scale: Tensor | None = None,
        device: torch.device | None = None,
        encoder: nn.Module | None = None,
        in_keys: Sequence[NestedKey] = ("observation", "action"),
        out_key: NestedKey = "state_action_value",
    ) -> None:
        super().__init__()
        self.in_keys, self.out_keys = list(in_keys), [out_key]
        self.num_networks, self.encoder = num_networks, encoder
        self.scale = nn.Identity() if input_scale is None else InputScale(input_scale.to(device))
        sizes = [observation_size + action_size, *hidden_sizes, num_outputs]
        self.network = EnsembleMLP(num_networks, sizes, device)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return values [E, …, n] in a new TensorDict of shape [E, …], for steps […]."""
        *entries, action = (tensordict[key] for key in self.in_keys)
        values = self.values(entries, action)
        return TensorDict({self.out_keys[0]: values}, batch_size=values.shape[:-1])

    def values(
        self, entries: Sequence[Tensor], action: Tensor, layers: tuple[Any, Layers] | None = None
    ) -> Tensor:
        """Return values [E, …, n]: `forward` without TensorDicts, with own or given parameters."""
        encoding, given = (None, None) if layers is None else layers
        if self.encoder is None:
            inputs = self.scale(entries[0] if len(entries) == 1 else torch.cat([*entries], -1))
        elif encoding is None:
            inputs = self.encoder(*entries)
        else:
            inputs = functional_call(self.encoder, encoding, tuple(entries))
        return self.network(torch.cat([inputs, action], -1), given)

    def layers(self, params: TensorDictBase) -> tuple[Any, Layers]:
        """Convert parameters with the same names as the own ones to the argument of `values`."""
        encoding = None
        if self.encoder is not None:
            flat = params["encoder"].flatten_keys(".")
            encoding = {str(name): value for name, value in flat.items()}
        return encoding, self.network.layers(params["network"])
