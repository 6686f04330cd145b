"""Actors and critics as perceptrons, and their layers: a fast tanh, scales of observations.

Scales are fixed factors, or running moments. Networks share no weights (Ray, Achiam, Amodei 2019,
section 5.1).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torchrl.modules import MLP

from safe_rl.models.heads import Head, action_sampler, gaussian_head


@cache
def cpuinfo() -> str:
    """Return Linux's description of the processor; an empty text elsewhere."""
    file = Path("/proc/cpuinfo")
    return file.read_text() if file.is_file() else ""


_MKL_IS_QUICK = torch.backends.mkl.is_available() and "GenuineIntel" in cpuinfo()
"""Whether torch computes the tanh by vector instructions of MKL, which MKL uses in full width on
Intel's processors only. It then takes a third of the time of `_TanhFunction`."""


class Tanh(nn.Tanh):
    """The hyperbolic tangent, five times as fast in single precision on an AMD processor.

    There it is computed as 2σ(2x) − 1: torch's logistic function takes a tenth of the time of its
    tanh, which took a third of an update. The absolute error is below 2e-7, like the rounding error
    of a layer's sums. On Intel's processors, on other devices, and when compiled, it is
    `torch.tanh`.

    Examples:
        >>> Tanh()(torch.tensor([0.0, 0.5])).round(decimals=6)
        tensor([0.0000, 0.4621])
    """

    def forward(self, input: Tensor) -> Tensor:
        """Return tanh of every element."""
        quick = input.device.type == "cpu" and input.dtype == torch.float32
        if _MKL_IS_QUICK or not quick or torch.compiler.is_compiling():
            return torch.tanh(input)
        # `input.requires_grad` is not known inside torch.func.vmap
        if not torch.is_grad_enabled():
            return _TanhFunction.forward(input)
        result: Tensor = _TanhFunction.apply(input)
        return result


class _TanhFunction(torch.autograd.Function):
    """Differentiable any number of times, by its own result; works with torch.func.vmap."""

    generate_vmap_rule = True

    @staticmethod
    def forward(x: Tensor) -> Tensor:
        # in place, because allocating a second tensor would take longer than computing it
        return (x + x).sigmoid_().mul_(2).sub_(1)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor], output: Tensor) -> None:
        ctx.save_for_backward(output)
        ctx.save_for_forward(output)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        (result,) = ctx.saved_tensors
        return torch.ops.aten.tanh_backward(gradient, result)

    @staticmethod
    def jvp(ctx: Any, tangent: Tensor) -> Tensor:
        (result,) = ctx.saved_tensors
        return tangent * (1 - result.square())


class Chain(nn.Sequential):
    """A sequence of modules, of which the first may take several inputs."""

    def forward(self, *inputs: Tensor) -> Any:
        """Run the modules."""
        first, *others = self
        outputs = first(*inputs)
        for module in others:
            outputs = module(outputs)
        return outputs


class InputScale(nn.Module):
    """Multiply the input [..., n] by fixed factors [n], so that its columns have similar ranges.

    Examples:
        >>> InputScale(torch.tensor([0.1, 1.0]))(torch.tensor([[20.0, 3.0]]))
        tensor([[2., 3.]])
    """

    scale: Tensor

    def __init__(self, scale: Tensor) -> None:
        super().__init__()
        self.register_buffer("scale", scale.detach().clone())

    def forward(self, inputs: Tensor) -> Tensor:
        """Scale ``inputs``."""
        return inputs * self.scale


def input_scale_vector(
    factors: Mapping[str, float], layout: Mapping[str, slice], size: int
) -> Tensor | None:
    """Convert factors per observation component to factors per column.

    Args:
        factors: Component name -> factor > 0. Other components have the factor 1.
        layout: Component name -> columns of the flat observation.
        size: Number n of columns. If a transform stacks frames, each has the columns of `layout`.

    Returns:
        Factors, shape [n], or None if no named component is observed. A name that is not in
        ``layout`` is skipped, because robots with different sensors use the same configuration.
    """
    observed = {name: factor for name, factor in factors.items() if name in layout}
    if not observed:
        return None
    scale = torch.ones(max(columns.stop for columns in layout.values()))
    for name, factor in observed.items():
        scale[layout[name]] = factor
    frames, others = divmod(size, len(scale))
    return torch.cat([scale.repeat(frames), torch.ones(others)])


_CONSTANT = 1e-12  # a column with a variance up to this is constant


class RunningScale(nn.Module):
    """Subtract a running mean, divide by a running standard deviation, and clip at ±``clip``.

    The moments are buffers in double precision: a checkpoint contains them with the weights, so a
    resumed run has the same results. Only `update` changes them. Training calls it once per
    batch, after learning from the batch, so that the log-probabilities of a batch stay those of the
    policy that collected it. Before the first update, inputs are only clipped.

    Args:
        size: Number of columns, n.
        key: Entry of a batch that is the input.
        clip: Bound of the outputs.
        device: Device of the moments.

    Examples:
        >>> from tensordict import TensorDict
        >>> scale = RunningScale(1, key="observation", clip=10.0)
        >>> scale.update(TensorDict(observation=torch.tensor([[1.0], [5.0]]), batch_size=[2]))
        >>> scale(torch.tensor([5.0]))
        tensor([1.])
    """

    count: Tensor
    mean: Tensor
    squares: Tensor

    def __init__(
        self, size: int, *, key: NestedKey, clip: float, device: torch.device | None = None
    ) -> None:
        super().__init__()
        self.key, self.clip = key, clip
        nothing = torch.zeros(size, dtype=torch.float64, device=device)
        self.register_buffer("count", nothing.new_zeros(()))
        self.register_buffer("mean", nothing)
        # sum of squared distances from the mean
        self.register_buffer("squares", nothing.clone())

    def forward(self, inputs: Tensor) -> Tensor:
        """Normalise ``inputs``, shape [..., n]."""
        variance = self.squares / self.count.clamp_min(1)
        # constant columns are only centred
        width = torch.where(variance > _CONSTANT, variance.sqrt(), 1.0)
        normalised = (inputs - self.mean.to(inputs)) / width.to(inputs)
        return normalised.clamp(-self.clip, self.clip)

    @torch.no_grad()
    def update(self, batch: TensorDictBase) -> None:
        """Add the samples of a batch (Chan, Golub, LeVeque 1979, equation 2.1)."""
        values = batch.get(self.key).to(self.mean).reshape(-1, self.mean.shape[0])
        number, mean = values.shape[0], values.mean(0)
        total, shift = self.count + number, mean - self.mean
        # in place, because compiled losses keep references to these tensors
        self.squares += (values - mean).square().sum(0)
        self.squares += shift.square() * (self.count * number / total)
        self.mean += shift * (number / total)
        self.count.copy_(total)


def update_running_scales(networks: Iterable[nn.Module], batch: TensorDictBase) -> None:
    """Update all running scales of networks with a batch."""
    for network in networks:
        for module in network.modules():
            if isinstance(module, RunningScale):
                module.update(batch)


def perceptron(
    in_features: int,
    out_features: int,
    hidden_sizes: Sequence[int],
    input_scale: Tensor | None,
    device: torch.device | None,
) -> nn.Sequential:
    """Tanh perceptron with Glorot-uniform weights, zero biases and a linear output."""
    perceptron = MLP(
        in_features, out_features, num_cells=list(hidden_sizes), activation_class=Tanh,
        device=device,
    )  # fmt: skip
    for layer in perceptron:
        if isinstance(layer, nn.Linear):
            nn.init.xavier_uniform_(layer.weight)
            nn.init.zeros_(layer.bias)
    scaling = [] if input_scale is None else [InputScale(input_scale.to(device))]
    return nn.Sequential(*scaling, *perceptron)


def make_actor(
    observation_size: int,
    action_size: int,
    *,
    hidden_sizes: Sequence[int],
    initial_log_std: float,
    input_scale: Tensor | None = None,
    device: torch.device | None = None,
) -> ProbabilisticTensorDictSequential:
    """Build a diagonal Gaussian policy with a state-independent standard deviation.

    Actions are not squashed: the environment clips them.

    Args:
        observation_size: Length of the flat observation.
        action_size: Length of the action.
        hidden_sizes: Width of every hidden layer.
        initial_log_std: Initial logarithm of the standard deviation.
        input_scale: Fixed factors, shape [observation_size], or None.
        device: Device of the parameters.

    Returns:
        A module with ``get_dist`` that writes ``loc``, ``scale``, ``action`` and
        ``action_log_prob``, shape [...] without a trailing 1.

    Examples:
        >>> make_actor(3, 2, hidden_sizes=[8], initial_log_std=-0.5).out_keys
        ['loc', 'scale', 'action', 'action_log_prob']
    """
    head = gaussian_head(action_size, initial_log_std, device)
    body = perceptron(observation_size, head.num_outputs, hidden_sizes, input_scale, device)
    return assemble_actor(body, head)


def assemble_actor(
    body: nn.Module,
    head: Head,
    *,
    in_keys: Sequence[NestedKey] = ("observation",),
    before: Sequence[TensorDictModuleBase] = (),
) -> ProbabilisticTensorDictSequential:
    """Put a head on a network `body` that reads the entries `in_keys`.

    Modules `before` write these entries if the environment does not.

    Returns:
        A module with ``get_dist`` that writes the distribution's parameters, ``action`` and
        ``action_log_prob``, shape [...].
    """
    parameters = Chain(body, head.parameters)
    return ProbabilisticTensorDictSequential(
        *before,
        TensorDictModule(parameters, in_keys=list(in_keys), out_keys=list(head.keys)),
        action_sampler(head.keys, head.distribution),
    )


def make_critic(
    observation_size: int,
    *,
    hidden_sizes: Sequence[int],
    input_scale: Tensor | None = None,
    device: torch.device | None = None,
    out_key: NestedKey = "state_value",
    num_outputs: int = 1,
) -> TensorDictModule:
    """Build a state-value network that writes ``out_key``, shape [..., num_outputs].

    Args:
        observation_size: Length of the flat observation.
        hidden_sizes: Width of every hidden layer.
        input_scale: Fixed factors, shape [observation_size], or None.
        device: Device of the parameters.
        out_key: Key of the value.
        num_outputs: Number of values: 1 for the reward, k for k constrained costs.

    Examples:
        >>> make_critic(3, hidden_sizes=[8], out_key="cost_value", num_outputs=2).out_keys
        ['cost_value']
    """
    network = perceptron(observation_size, num_outputs, hidden_sizes, input_scale, device)
    return TensorDictModule(network, in_keys=["observation"], out_keys=[out_key])
