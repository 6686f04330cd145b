"""Scales of observations: fixed factors, and running moments that are part of the networks."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor, nn


class InputScale(nn.Module):
    """Multiply the input by a fixed vector, so that all its components have similar ranges.

    Args:
        scale: Factors, shape [n], one per input component.

    Examples:
        >>> import torch
        >>> InputScale(torch.tensor([0.1, 1.0]))(torch.tensor([[20.0, 3.0]]))
        tensor([[2., 3.]])
    """

    scale: Tensor

    def __init__(self, scale: Tensor) -> None:
        super().__init__()
        self.register_buffer("scale", scale.detach().clone())

    def forward(self, inputs: Tensor) -> Tensor:
        """Scale ``inputs``, shape [..., n]."""
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

    Examples:
        >>> input_scale_vector({"gyro": 0.5}, {"gyro": slice(0, 2), "lidar": slice(2, 3)}, 3)
        tensor([0.5000, 0.5000, 1.0000])
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
        >>> import torch
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


def take_in(networks: Iterable[nn.Module], batch: TensorDictBase) -> None:
    """Update all running scales of networks with a batch."""
    for network in networks:
        for module in network.modules():
            if isinstance(module, RunningScale):
                module.update(batch)
