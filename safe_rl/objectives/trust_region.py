"""Pieces of a trust-region step: flat parameters, Fisher products, conjugate gradients, search."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential
from torch import Tensor, nn

from safe_rl.objectives.gaussian import gaussian_kl, normal_parameters

Gaussian = tuple[Tensor, Tensor]


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


def policy_gaussian(
    actor_network: ProbabilisticTensorDictSequential, batch: TensorDictBase
) -> Gaussian:
    """Mean and standard deviation of the policy in the states of a batch, both [..., n]."""
    observed = batch.select(*actor_network.in_keys)
    return normal_parameters(actor_network.get_dist(observed))


@torch.no_grad()
def mean_kl(
    reference: Gaussian, actor_network: ProbabilisticTensorDictSequential, batch: TensorDictBase
) -> Tensor:
    """Mean over states of KL(π_θ ‖ reference), scalar."""
    return gaussian_kl(*policy_gaussian(actor_network, batch), *reference).mean()


def subsample(batch: TensorDictBase, fraction: float) -> TensorDictBase:
    """Every ⌊1/fraction⌉-th sample of a flat batch [B]: spread over all episodes, no randomness.

    Raises:
        ValueError: if `fraction` is not in (0, 1].
    """
    if not 0 < fraction <= 1:
        raise ValueError(f"fisher_subsample must be in (0, 1], got {fraction}.")
    return batch[:: round(1 / fraction)]


class FisherProduct:
    """Product of a vector with the Fisher matrix of a Gaussian policy, plus damping.

    The Fisher matrix is the Hessian of the mean KL(π_θ ‖ π_k) at θ_k: Jᵀ M J with J the Jacobian
    of mean and standard deviation with respect to θ, and M their own, diagonal, Fisher matrix,
    1/σ² for a mean and 2/σ² for a standard deviation σ. J v comes from differentiating the
    vector-Jacobian product uᵀJ, which is linear in u, with respect to u. Both graphs are built
    once, so that a product costs two backward passes.

    Args:
        actor_network: policy with `get_dist` and a Gaussian distribution; any network that can
            be differentiated twice.
        batch: states to average over, any batch shape.
        parameters: θ, the parameters of the actor to differentiate by.
        damping: multiple of the identity that is added.

    Examples:
        >>> from tensordict import TensorDict
        >>> from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
        >>> from torchrl.modules import IndependentNormal, ProbabilisticActor
        >>> net = nn.Sequential(nn.Linear(3, 2), AddStateIndependentNormalScale(2))
        >>> actor = ProbabilisticActor(
        ...     TensorDictModule(net, in_keys=["observation"], out_keys=["loc", "scale"]),
        ...     in_keys=["loc", "scale"],
        ...     distribution_class=IndependentNormal,
        ... )
        >>> batch = TensorDict(observation=torch.randn(8, 3), batch_size=[8])
        >>> fisher = FisherProduct(actor, batch, list(actor.parameters()), damping=0.1)
        >>> fisher(torch.ones(10)).shape
        torch.Size([10])
    """

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        batch: TensorDictBase,
        parameters: Sequence[nn.Parameter],
        damping: float,
    ) -> None:
        self.parameters, self.damping = list(parameters), damping
        loc, scale = policy_gaussian(actor_network, batch)
        precision = scale.detach().square().reciprocal() / (scale.numel() / scale.shape[-1])
        # A mean or a standard deviation that is constant has no part in the Fisher matrix.
        trained = [
            (output, metric)
            for output, metric in ((loc, precision), (scale, 2 * precision))
            if output.requires_grad
        ]
        self._outputs = [output for output, _ in trained]
        self._metrics = [metric for _, metric in trained]
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
        """Multiply a vector [P]."""
        tangents = unflatten(vector, self.parameters)
        used = [(vjp, v) for vjp, v in zip(self._vjp, tangents, strict=True) if vjp.requires_grad]
        jvp = torch.autograd.grad(
            [vjp for vjp, _ in used], self._dummies, [v for _, v in used], retain_graph=True
        )
        weighted = [metric * change for metric, change in zip(self._metrics, jvp, strict=True)]
        product = torch.autograd.grad(
            self._outputs,
            self.parameters,
            weighted,
            retain_graph=True,
            materialize_grads=True,
            allow_unused=True,
        )
        return flatten(product) + self.damping * vector


def conjugate_gradient(
    product: Callable[[Tensor], Tensor], right: Tensor, iterations: int, tolerance: float = 1e-10
) -> Tensor:
    """Solve A x = right for a symmetric positive definite A (Hestenes and Stiefel 1952).

    Args:
        product: multiplies a vector [P] with A.
        right: right-hand side, [P]; for 0 the solution is 0.
        iterations: products at most.
        tolerance: squared residual, relative to that of x = 0, at which to stop.

    Returns:
        x, [P].

    Examples:
        >>> conjugate_gradient(lambda x: 2 * x, torch.tensor([2.0, 4.0]), iterations=10)
        tensor([1., 2.])
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
    return solution


def backtracking_search(
    parameters: Sequence[nn.Parameter],
    step: Tensor,
    accept: Callable[[], bool],
    *,
    coeff: float,
    max_tries: int,
) -> float:
    """Move parameters along a step, shortening it until it is accepted.

    Args:
        parameters: moved in place; left at their old values if no step is accepted.
        step: full step, [P].
        accept: called with the parameters moved.
        coeff: factor in (0, 1) between one try and the next.
        max_tries: number of tries, the full step included.

    Returns:
        The accepted fraction of the step: a power of `coeff`, or 0 if none was accepted.
    """
    start = flatten(parameters).detach()
    for tries in range(max_tries):
        fraction = coeff**tries
        set_parameters(parameters, start + fraction * step)
        if accept():
            return fraction
    set_parameters(parameters, start)
    return 0.0
