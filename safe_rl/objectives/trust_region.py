"""Functions for trust-region steps: flat parameters, KL, conjugate gradients, line search."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential
from torch import Tensor, nn
from torch.distributions import Distribution
from torchrl.modules import set_recurrent_mode

from safe_rl.objectives.distributions import ReferencePolicy
from safe_rl.objectives.samples import inputs_of

#: Squared sine of the angle below which two approximate solutions count as parallel.
_SAME_DIRECTION = 1e-5


def flatten(tensors: Iterable[Tensor]) -> Tensor:
    """Concatenate tensors to one vector [P]."""
    return torch.cat([tensor.reshape(-1) for tensor in tensors])


def unflatten(vector: Tensor, like: Sequence[Tensor]) -> list[Tensor]:
    """Cut a vector [P] into tensors of given shapes."""
    pieces = vector.split([tensor.numel() for tensor in like])
    return [piece.view_as(tensor) for piece, tensor in zip(pieces, like, strict=True)]


@torch.no_grad()
def set_parameters(parameters: Sequence[nn.Parameter], vector: Tensor) -> None:
    """Overwrite parameters, in place, with a vector [P]."""
    for parameter, value in zip(parameters, unflatten(vector, parameters), strict=True):
        parameter.copy_(value)


def flat_gradient(
    output: Tensor, parameters: Sequence[nn.Parameter], retain_graph: bool = False
) -> Tensor:
    """Gradient of a scalar with respect to parameters, [P]; 0 for those it does not depend on."""
    return flatten(
        torch.autograd.grad(
            output, parameters, retain_graph=retain_graph, materialize_grads=True, allow_unused=True
        )
    )


def policy_in(
    actor_network: ProbabilisticTensorDictSequential, batch: TensorDictBase
) -> Distribution:
    """Distribution of the policy in the states of a batch; a recurrent policy reads sequences."""
    with set_recurrent_mode(True):
        return actor_network.get_dist(inputs_of(actor_network, batch))


@torch.no_grad()
def mean_kl(
    reference: ReferencePolicy,
    actor_network: ProbabilisticTensorDictSequential,
    batch: TensorDictBase,
) -> Tensor:
    """Mean over states of KL(π_θ ‖ reference), scalar."""
    return reference.kl(policy_in(actor_network, batch)).mean()


def subsample(batch: TensorDictBase, fraction: float) -> TensorDictBase:
    """A fraction of the samples of a flat batch [B]: evenly spaced ones, without randomness."""
    if fraction == 1:
        return batch
    # The small numbers undo rounding, such as in 7 / 0.07 = 99.999….
    count = math.ceil(batch.shape[0] * fraction - 1e-9)
    index = (torch.arange(count, dtype=torch.float64) / fraction + 1e-9).long()
    return batch[index.to(batch.device)]


def conjugate_gradient(
    product: Callable[[Tensor], Tensor], right: Tensor, iterations: int, tolerance: float = 1e-10
) -> tuple[Tensor, Tensor]:
    """Solve A x = right for a symmetric positive definite A (Hestenes and Stiefel 1952).

    Args:
        product: Multiplies a vector [P] with A.
        right: Right-hand side, [P]; for 0 the solution is 0.
        iterations: Largest number of products.
        tolerance: Squared residual, relative to that of x = 0, at which to stop.

    Returns:
        x, [P], which may not have converged; and A x, which needs no further product.

    Examples:
        >>> conjugate_gradient(lambda x: 2 * x, torch.tensor([2.0, 4.0]), iterations=10)
        (tensor([1., 2.]), tensor([2., 4.]))
    """
    solution = torch.zeros_like(right)
    residual, direction = right.clone(), right.clone()
    squared = first = residual @ residual
    for _ in range(iterations):
        if squared <= tolerance * first:
            break
        image = product(direction)
        length = squared / (direction @ image)
        solution = solution + length * direction
        residual = residual - length * image
        previous, squared = squared, residual @ residual
        direction = residual + (squared / previous) * direction
    return solution, right - residual


def best_in_span(solutions: Tensor, images: Tensor, right: Tensor) -> Tensor:
    """Solve A x = right for several right-hand sides within the span of approximate solutions.

    These are the Galerkin solutions: of all combinations of the approximate solutions, the best in
    the norm of A. Solutions of conjugate gradients that were stopped early do not agree with each
    other, but these do: for any two, xᵢᵀ A xⱼ = rightᵢᵀ xⱼ = rightⱼᵀ xᵢ.

    Args:
        solutions: Approximate solutions xᵢ, [m, P]; any of them may depend on others or be 0.
        images: A xᵢ, [m, P].
        right: Right-hand sides, [m, P].

    Returns:
        Solutions, [m, P].
    """
    gram = solutions.double() @ images.double().T
    lengths = gram.diagonal().clamp_min(0).sqrt()
    inverse_lengths = torch.where(lengths > 0, 1 / lengths, 0.0)
    scale = inverse_lengths[:, None] * inverse_lengths
    cosines = 0.5 * (gram + gram.T) * scale
    # Directions that differ by no more than single precision's rounding are one direction.
    inverse = torch.linalg.pinv(cosines, rtol=_SAME_DIRECTION, hermitian=True) * scale
    combinations = (right.double() @ solutions.double().T) @ inverse
    return combinations.to(solutions) @ solutions


def backtracking_search(
    parameters: Sequence[nn.Parameter],
    step: Tensor,
    accept: Callable[[], bool],
    *,
    coeff: float,
    max_tries: int,
) -> float:
    """Change parameters by a step, which is shortened until it is accepted.

    Args:
        parameters: Changed in place; they keep their old values if no step is accepted or `accept`
            raises.
        step: Full step, [P].
        accept: Called after the parameters have been changed; whether the step is accepted.
        coeff: Factor in (0, 1) between one try and the next.
        max_tries: Number of tries, the full step included.

    Returns:
        The accepted fraction of the step: a power of `coeff`, or 0 if none was accepted.
    """
    start, accepted = flatten(parameters).detach(), 0.0
    try:
        for tries in range(max_tries):
            fraction = coeff**tries
            set_parameters(parameters, start + fraction * step)
            if accept():
                accepted = fraction
                break
    finally:
        if not accepted:
            set_parameters(parameters, start)
    return accepted
