"""Activations of networks."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from safe_rl.processor import cpuinfo

__all__ = ["Tanh"]

_MKL_IS_QUICK = torch.backends.mkl.is_available() and "GenuineIntel" in cpuinfo()
"""Whether torch takes its tangents from MKL's vectors, which only Intel's processors go through
in full width: a third of the time of what is below."""


class Tanh(nn.Tanh):
    """The hyperbolic tangent, five times as fast in single precision on an AMD processor.

    There it is computed as 2σ(2x) − 1: torch's logistic function takes a tenth of the time of its
    tangent, which was a third of an update's. The absolute error is below 2e-7, as large as that
    of the sums which are put in. On Intel's processors, on other devices, and where compiled, it
    is :func:`torch.tanh`.

    Examples:
        >>> Tanh()(torch.tensor([0.0, 0.5])).round(decimals=6)
        tensor([0.0000, 0.4621])
    """

    def forward(self, input: Tensor) -> Tensor:
        """Return tanh of every element."""
        quick = input.device.type == "cpu" and input.dtype == torch.float32
        if _MKL_IS_QUICK or not quick or torch.compiler.is_compiling():
            return torch.tanh(input)
        # what is mapped over a batch does not tell whether a gradient will be asked for
        if not torch.is_grad_enabled():
            return _tanh(input)
        result: Tensor = _TanhFunction.apply(input)
        return result


def _tanh(x: Tensor) -> Tensor:
    # in place: a second tensor would take longer to allocate than to compute
    return (x + x).sigmoid_().mul_(2).sub_(1)


class _TanhFunction(torch.autograd.Function):
    """Differentiable as often as one likes, by its own result; maps over batches, too."""

    generate_vmap_rule = True

    @staticmethod
    def forward(x: Tensor) -> Tensor:
        return _tanh(x)

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
