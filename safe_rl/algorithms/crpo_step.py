"""Step of constraint-rectified policy optimisation (Xu, Liang and Lan 2021)."""

from __future__ import annotations

from typing import Any

import torch

from safe_rl.algorithms.trust_region_step import Loss, Proposal, StepProblem, TRPOStep
from safe_rl.ranges import NotNegative

__all__ = ["CRPOStep"]


class CRPOStep(TRPOStep):
    """A step for the reward while all costs are within d + η, else one against a cost.

    The algorithm of Xu, Liang and Lan 2021, with a trust region for the policy update: if
    J_cᵢ ≤ dᵢ + η for all i, a `TRPOStep` on the loss, otherwise one on E[ρA_cᵢ] of the cost that
    is exceeded most, in its own units. (The article takes any of the exceeded ones.) There is
    no multiplier, and nothing to tune but η.

    Adds ``reduces`` to the diagnostics, [k]: 1 for the cost that the step was against.

    Args:
        loss: a `CPOLoss`, or a callable of your own that returns a TensorDict with scalars
            ``loss_…`` and the differentiable ``cost_surrogate``, [k].
        tolerance: Tolerated violation η, undiscounted cost per episode.
        settings: Those of every step, see `TRPOStep`.

    Examples:
        >>> from tensordict import TensorDict
        >>> from safe_rl.models import make_actor
        >>> from safe_rl.objectives import CPOLoss
        >>> actor = make_actor(3, 2, hidden_sizes=[16], initial_log_std=-0.5)
        >>> with torch.no_grad():
        ...     batch = actor(TensorDict(observation=torch.randn(8, 3), batch_size=[8]))
        >>> batch["advantage"], batch["cost_advantage"] = torch.randn(8, 1), torch.randn(8, 2)
        >>> search = {"cg_iterations": 10, "backtrack_coeff": 0.8, "max_backtracks": 10}
        >>> loss = CPOLoss(actor, entropy_coeff=0.0)
        >>> step = CRPOStep(loss, tolerance=2.0, target_kl=0.01, damping=0.1, **search)
        >>> step(batch, cost_violation=torch.tensor([1.0, 5.0]))["reduces"]
        tensor([0., 1.])
    """

    def __init__(self, loss: Loss, *, tolerance: NotNegative, **settings: Any) -> None:
        super().__init__(loss, **settings)
        self.tolerance = tolerance

    def _propose(self, problem: StepProblem) -> Proposal:
        excess = problem.violation - self.tolerance
        worst = int(excess.argmax())
        reduces = torch.zeros_like(excess)
        if excess[worst] > 0:
            reduces[worst] = 1.0
            proposal = self._natural_step(problem, lambda of: of["cost_surrogate"][worst])
        else:
            proposal = super()._propose(problem)
        return proposal._replace(diagnostics={**proposal.diagnostics, "reduces": reduces})
