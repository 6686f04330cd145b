"""Functions for trust-region steps: flat parameters, Fisher matrix, solvers."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential
from torch import Tensor, nn
from torch.distributions import Categorical, Distribution, Normal
from torchrl.modules import set_recurrent_mode

from safe_rl.objectives.distributions import ReferencePolicy, root, sampler_of
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
    """Solve A x = right [m, P] within the span of approximate solutions xᵢ, [m, P].

    These are the Galerkin solutions: of all combinations of the approximate solutions, the best in
    the norm of A. Solutions of conjugate gradients that were stopped early do not agree with each
    other, but these do: for any two, xᵢᵀ A xⱼ = rightᵢᵀ xⱼ = rightⱼᵀ xᵢ. `images` are A xᵢ, [m, P].
    Approximate solutions may depend on others, or be 0.
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


#: Outputs of a policy's network, and multiplication by the Fisher matrix with respect to them.
Geometry = tuple[list[Tensor], Callable[[Sequence[Tensor]], list[Tensor]]]


def _normal_geometry(normal: Normal, num_states: int) -> Geometry:
    """Fisher matrix of a Gaussian: 1/σ² for its mean and 2/σ² for its standard deviation σ."""
    precision = normal.scale.detach().square().reciprocal() / num_states
    # A constant mean or standard deviation does not enter the Fisher matrix.
    trained = [
        (output, metric)
        for output, metric in ((normal.loc, precision), (normal.scale, 2 * precision))
        if output.requires_grad
    ]
    metrics = [metric for _, metric in trained]

    def multiply(changes: Sequence[Tensor]) -> list[Tensor]:
        return [metric * change for metric, change in zip(metrics, changes, strict=True)]

    return [output for output, _ in trained], multiply


def _categorical_geometry(categorical: Categorical, num_states: int) -> Geometry:
    """Fisher matrix of a categorical distribution for its log-probabilities: diag(p) − ppᵀ."""
    probs = categorical.probs.detach()

    def multiply(changes: Sequence[Tensor]) -> list[Tensor]:
        centred = changes[0] - (probs * changes[0]).sum(-1, keepdim=True)
        return [probs * centred / num_states]

    return [categorical.logits], multiply


def _geometry_by_differentiation(
    actor: ProbabilisticTensorDictSequential, batch: TensorDictBase
) -> Geometry:
    """Hessian of the mean KL(π ‖ π_k) with respect to the distribution's parameters, at π_k.

    At π_k the gradient of the divergence is 0. So JᵀMJ, where M is this Hessian, is the complete
    Hessian with respect to θ.
    """
    sampler = sampler_of(actor)
    parameters = actor.get_dist_params(inputs_of(actor, batch)).select(*sampler.in_keys)
    keys = [key for key, output in parameters.items(True, True) if output.requires_grad]
    outputs = [parameters.get(key) for key in keys]
    moved = parameters.detach()
    leaves = [output.detach().requires_grad_() for output in outputs]
    for key, leaf in zip(keys, leaves, strict=True):
        moved.set(key, leaf)
    reference = ReferencePolicy(sampler.get_dist(parameters.detach()))
    divergence = reference.kl(sampler.get_dist(moved)).mean()
    slopes = torch.autograd.grad(divergence, leaves, create_graph=True)

    def multiply(changes: Sequence[Tensor]) -> list[Tensor]:
        product = torch.autograd.grad(
            slopes, leaves, changes, retain_graph=True, materialize_grads=True, allow_unused=True
        )
        return list(product)

    return outputs, multiply


def policy_geometry(actor: ProbabilisticTensorDictSequential, batch: TensorDictBase) -> Geometry:
    """Outputs of a policy's network in the states of a batch, and their mean Fisher matrix."""
    distribution = policy_in(actor, batch)
    base, num_states = root(distribution), max(1, distribution.batch_shape.numel())
    if isinstance(base, Normal):
        return _normal_geometry(base, num_states)
    if isinstance(base, Categorical):
        return _categorical_geometry(base, num_states)
    return _geometry_by_differentiation(actor, batch)


class FisherProduct:
    """Product of a vector with the Fisher matrix of a policy, plus damping.

    The Fisher matrix is the Hessian of the mean KL(π_θ ‖ π_k) at θ_k. It is Jᵀ M J, where J is the
    Jacobian of the network's outputs with respect to θ, and M is the Fisher matrix with respect to
    the outputs. M has a closed form for Gaussian and categorical policies; for others the
    divergence is differentiated twice. J v is the derivative of the vector-Jacobian product uᵀJ,
    which is linear in u, with respect to u. Both graphs are built once, so a product costs two
    backward passes.

    Args:
        actor_network: Policy with `get_dist`; any network that can be differentiated twice.
        batch: States to average over, any batch shape.
        parameters: θ, the parameters of the actor to differentiate by.
        damping: Multiple of the identity that is added.
    """

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        batch: TensorDictBase,
        parameters: Sequence[nn.Parameter],
        damping: float,
    ) -> None:
        self.parameters, self.damping = list(parameters), damping
        # cuDNN's recurrent networks cannot be differentiated twice
        with torch.backends.cudnn.flags(enabled=False), set_recurrent_mode(True):
            self._outputs, self._metric = policy_geometry(actor_network, batch)
        self._dummies = [torch.zeros_like(output, requires_grad=True) for output in self._outputs]
        self._vjp = torch.autograd.grad(
            self._outputs,
            self.parameters,
            self._dummies,
            create_graph=True,
            materialize_grads=True,
            allow_unused=True,
        )

    def __call__(self, vector: Tensor) -> Tensor:
        """Multiply the damped Fisher matrix by a vector [P]."""
        tangents = unflatten(vector, self.parameters)
        used = [(vjp, v) for vjp, v in zip(self._vjp, tangents, strict=True) if vjp.requires_grad]
        jvp = torch.autograd.grad(
            [vjp for vjp, _ in used], self._dummies, [v for _, v in used], retain_graph=True
        )
        product = torch.autograd.grad(
            self._outputs,
            self.parameters,
            self._metric(jvp),
            retain_graph=True,
            materialize_grads=True,
            allow_unused=True,
        )
        return flatten(product) + self.damping * vector
