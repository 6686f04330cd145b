"""Steps within a trust region (Schulman et al. 2015)."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Annotated, NamedTuple

import torch
from annotated_types import Interval
from pydantic import NonNegativeFloat, PositiveFloat
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential
from torch import Tensor, nn
from torchrl.objectives import LossModule

from safe_rl.algorithms.algorithm_contract import PolicyUpdate
from safe_rl.algorithms.losses import finite_sum
from safe_rl.objectives.distributions import ReferencePolicy
from safe_rl.objectives.limits import LimitState
from safe_rl.objectives.samples import learning_samples
from safe_rl.objectives.surrogate import SurrogateLoss
from safe_rl.objectives.trust_region import (
    FisherProduct,
    best_in_span,
    conjugate_gradient,
    flat_gradient,
    flatten,
    policy_in,
    set_parameters,
)

Loss = Callable[[TensorDictBase], TensorDictBase]
"""A loss module, or a function of your own from a batch to scalars ``loss_…``."""


def require_limits(limits: LimitState | None) -> LimitState:
    """The state of the limits, which constrained steps need."""
    if limits is None:
        raise ValueError(
            "A constrained step needs the state of the limits: pass what "
            "Constraints.update(batch, episodes) returns, step(batch, limits)."
        )
    return limits


def cost_surrogates(losses: TensorDictBase) -> Tensor:
    """The surrogates of the costs, [k], which constrained steps need."""
    surrogates = losses.get("cost_surrogate", None)
    if surrogates is None:
        raise ValueError(
            f"A constrained step needs a loss that returns 'cost_surrogate', such as CPOLoss; this "
            f"one returns {sorted(losses.keys())}."
        )
    return surrogates


class Proposal(NamedTuple):
    """A full step, and the conditions under which a line search may take it."""

    step: Tensor  # change of the parameters, [P]
    # of the losses and the KL divergence after a step, which is at most δ: whether to take the step
    is_acceptable: Callable[[TensorDictBase, Tensor], bool]
    diagnostics: dict[str, Tensor]  # values to log about the step


class TRPOStep(PolicyUpdate):
    """Natural-gradient step on a loss, within a trust region (Schulman et al. 2015, appendix C).

    The step is √(2δ / xᵀHx)·x with H x = −g solved by conjugate gradients, H the Fisher matrix of
    the policy plus damping. A backtracking line search takes its first fraction with
    KL(π_θ ‖ π_k) ≤ δ that does not worsen the loss. If there is none, the policy does not change.

    Args:
        loss: A `TRPOLoss`, or a callable of your own that returns a TensorDict with scalars
            ``loss_…``, whose sum is minimised.
        target_kl: Radius δ of the trust region, mean KL divergence over the states of the batch.
        damping: Multiple of the identity added to the Fisher matrix.
        cg_iterations: Iterations of the conjugate gradient method, for every linear system.
        backtrack_coeff: Factor by which the line search shortens a step that it has rejected.
        max_backtracks: Largest number of tries of the line search, the full step included.
        actor_network: Policy that the step changes; by default ``loss.actor_network``.

    Examples:
        >>> from tensordict import TensorDict
        >>> from safe_rl.models import make_actor
        >>> from safe_rl.objectives import TRPOLoss
        >>> actor = make_actor(3, 2, hidden_sizes=[8], initial_log_std=-0.5)
        >>> with torch.no_grad():
        ...     batch = actor(TensorDict(observation=torch.randn(8, 3), batch_size=[8]))
        >>> batch["advantage"] = torch.randn(8, 1)
        >>> search = {"cg_iterations": 10, "backtrack_coeff": 0.8, "max_backtracks": 10}
        >>> region = {"target_kl": 0.01, "damping": 0.1, **search}
        >>> step = TRPOStep(TRPOLoss(actor, entropy_coeff=0.01), **region)
        >>> bool(step(batch)["kl"] <= 0.01)
        True
    """

    def __init__(
        self,
        loss: Loss,
        *,
        target_kl: PositiveFloat,
        damping: NonNegativeFloat,
        cg_iterations: Annotated[int, Interval(ge=1, le=10_000)],
        backtrack_coeff: Annotated[float, Interval(gt=0, lt=1)],
        max_backtracks: Annotated[int, Interval(ge=1, le=10_000)],
        actor_network: ProbabilisticTensorDictSequential | None = None,
    ) -> None:
        self.loss = loss
        if actor_network is None:
            if not isinstance(loss, LossModule):
                raise ValueError("The loss is no LossModule: pass the policy as actor_network.")
            actor_network = loss.actor_network
        self.target_kl, self.damping, self.cg_iterations = target_kl, damping, cg_iterations
        self.backtrack_coeff, self.max_backtracks = backtrack_coeff, max_backtracks
        self.actor_network = actor_network
        self.parameters = [p for p in self.actor_network.parameters() if p.requires_grad]

    def __call__(
        self, batch: TensorDictBase, limits: LimitState | None = None
    ) -> dict[str, Tensor]:
        """Take one step.

        Args:
            batch: On-policy data with the entries that the loss reads, of any shape; padding is not
                used.
            limits: State of the limits; constrained steps and losses with costs need it.

        Returns:
            The outputs of the loss after the step, ``kl`` (mean KL(π_θ ‖ π_k)), ``step_fraction``
            (share of the full step that the line search accepted; 0: none, or the gradient was 0),
            ``backtracks`` (number of rejected tries) and the diagnostics of the step itself.

        Raises:
            FloatingPointError: If an entry of the batch, the loss or the step is not finite; then
                the policy has not changed.
        """
        batch = learning_samples(batch, self.actor_network.in_keys, self.loss)
        with torch.no_grad():
            reference = ReferencePolicy(policy_in(self.actor_network, batch))
        if isinstance(self.loss, SurrogateLoss):
            self.loss.prepare(batch, limits)
        losses = self.loss(batch)
        fisher = FisherProduct(self.actor_network, batch, self.parameters, self.damping)
        proposal = self._propose(losses, fisher, limits)
        del fisher
        if not proposal.step.isfinite().all():
            raise FloatingPointError(
                "The step of the policy is not finite, although the batch is; no parameter has "
                "been changed. Look for a policy that has collapsed (policy_entropy, and the "
                "spread of the advantages), or raise the damping."
            )
        metrics = self._search(batch, reference, proposal)
        return metrics | proposal.diagnostics

    def _propose(
        self, losses: TensorDictBase, fisher: FisherProduct, limits: LimitState | None
    ) -> Proposal:
        """Compute a step from the differentiable losses before it and the damped Fisher matrix."""
        return self._natural_step(losses, fisher, finite_sum)

    def _natural_step(
        self,
        losses: TensorDictBase,
        fisher: FisherProduct,
        objective: Callable[[TensorDictBase], Tensor],
    ) -> Proposal:
        """The longest step, within the trust region, down the natural gradient of an objective."""
        loss = objective(losses)
        gradient = flat_gradient(loss, self.parameters)
        direction, _ = conjugate_gradient(fisher, gradient, self.cg_iterations)
        step, before = self._longest(direction, gradient), loss.detach()
        return Proposal(step, lambda after, kl: bool(objective(after) <= before), {})

    def _longest(self, x: Tensor, g: Tensor) -> Tensor:
        """The longest step along −x within the trust region, [P], for a solution x of H x = g."""
        # Conjugate gradients leave a residual orthogonal to x, so that xᵀHx = xᵀg.
        squared = (g @ x).clamp_min(0)
        return -torch.where(squared > 0, (2 * self.target_kl / squared).sqrt(), 0.0) * x

    def _gradients(self, surrogates: Iterable[Tensor]) -> Tensor:
        """Gradients of k scalars, [k, P]; their graph is kept for further derivatives."""
        rows = [flat_gradient(row, self.parameters, retain_graph=True) for row in surrogates]
        return torch.stack(rows) if rows else flatten(self.parameters).detach()[None, :][:0]

    def _solve_all(self, fisher: FisherProduct, g: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
        """Solutions v = H⁻¹g, [P], and wᵢ = H⁻¹bᵢ, [k, P], that are consistent with each other.

        A few iterations of conjugate gradients leave residuals of tens of percents. Then gᵀw, bᵀv
        and wᵀHv are three different numbers, but the dual needs one r. In the span of the solutions
        they are equal, and a step keeps linearised constraints and the radius exactly.
        """
        right = torch.cat([g[None], b])
        pairs = [conjugate_gradient(fisher, row, self.cg_iterations) for row in right]
        solutions, images = (torch.stack(rows) for rows in zip(*pairs, strict=True))
        solved = best_in_span(solutions, images, right)
        return solved[0], solved[1:]

    @torch.no_grad()
    def _search(
        self, batch: TensorDictBase, reference: ReferencePolicy, proposal: Proposal
    ) -> dict[str, Tensor]:
        """Change the parameters by the first acceptable fraction of a step, if there is one."""
        start, accepted, rejected = flatten(self.parameters).detach(), 0.0, 0
        max_tries = self.max_backtracks if proposal.step.any() else 0
        try:
            while not accepted and rejected < max_tries:
                fraction = self.backtrack_coeff**rejected
                set_parameters(self.parameters, start + fraction * proposal.step)
                kl = reference.kl(policy_in(self.actor_network, batch)).mean()
                if kl <= self.target_kl and proposal.is_acceptable(after := self.loss(batch), kl):
                    accepted = fraction
                else:
                    rejected += 1
        finally:  # also if the loss raises an error
            if not accepted:
                set_parameters(self.parameters, start)
        if not accepted:
            after, kl = self.loss(batch), proposal.step.new_zeros(())
        return {
            **after.to_dict(),
            "kl": kl,
            "step_fraction": torch.tensor(accepted),
            "backtracks": torch.tensor(rejected),
        }

    def loss_modules(self) -> dict[str, nn.Module]:
        """The loss, if it is a module."""
        return {"loss": self.loss} if isinstance(self.loss, nn.Module) else {}
