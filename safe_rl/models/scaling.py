"""Fixed factors that bring the components of an observation to similar ranges."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor, nn

__all__ = ["InputScale", "input_scale_vector"]


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
    factors: Mapping[str, float], layout: Mapping[str, slice], device: torch.device | None = None
) -> Tensor | None:
    """Turn factors per observation component into one factor per column.

    Args:
        factors: Component name -> factor. Components not named keep the factor 1.
        layout: Component name -> columns of the flat observation.
        device: Device of the result.

    Returns:
        Factors, shape [n] with n the number of columns, or None if none of the named components is
        observed. A name that is absent from ``layout`` is skipped, because one configuration serves
        robots with different sensors.

    Raises:
        ValueError: If a factor is not a positive finite number.

    Examples:
        >>> input_scale_vector({"gyro": 0.5}, {"gyro": slice(0, 2), "lidar": slice(2, 3)})
        tensor([0.5000, 0.5000, 1.0000])
    """
    for name, factor in factors.items():
        if not (math.isfinite(factor) and factor > 0):
            raise ValueError(
                f"The input scale of '{name}' is {factor}: it must be positive and finite. "
                "Remove the entry to leave the component as it is."
            )
    observed = {name: factor for name, factor in factors.items() if name in layout}
    if not observed:
        return None
    scale = torch.ones(max(columns.stop for columns in layout.values()), device=device)
    for name, factor in observed.items():
        scale[layout[name]] = factor
    return scale
