"""Steps that lower a cost while its limit is violated: C-TRPO and CRPO."""

from __future__ import annotations

from typing import Any

import torch
from pydantic import NonNegativeFloat
from tensordict import TensorDictBase
from torch import Tensor

from safe_rl.algorithms.losses import finite_sum
from safe_rl.algorithms.trust_region_step import (
    Loss,
    Proposal,
    TRPOStep,
    cost_surrogates,
    require_limits,
)
from safe_rl.checks import Fraction
from safe_rl.objectives.limits import LimitState
from safe_rl.objectives.multipliers import CostLimits, parse_cost_limits
from safe_rl.objectives.trust_region import FisherProduct, flat_gradient


def barrier_divergence(change: Tensor, slack: Tensor) -> Tensor:
    """Bregman divergence, for x log x, between two distances of a cost to its limit.

    D(s − a, s) = a + (s − a) log((s − a)/s), where a is the change of the cost, and s > 0 the slack
    before it. At a = 0, its value and its slope are 0 and its curvature is 1/s. Beyond the limit it
    is infinite.
    """
    a, s = change.double(), slack.double()
    # the logarithm of (s - a)/s would lose a small a beside a large s
    inside = a + torch.special.xlog1py((s - a).clamp_min(0), -a / s)
    return torch.where(a > s, torch.inf, inside).to(change)


class CTRPOStep(TRPOStep):
    """A step within a trust region of safe policies (C-TRPO).

    The trust region is defined by the divergence (Milosevic et al. 2025)

        D_C(π_θ ‖ π_k) = KL(π_θ ‖ π_k) + β Σᵢ D_φ(dᵢ − J_cᵢ(θ), dᵢ − J_cᵢ(θ_k)) ≤ δ

    with `barrier_divergence` as D_φ and J_c(θ) − J_c(θ_k) = T̄ E[(ρ − 1) A_c]. The mean episode
    length T̄ converts an average per step to an undiscounted sum, as 1/(1 − γ) converts it to a
    discounted sum in the article. The Hessian of D_C at θ_k is H + β T̄² Σᵢ bᵢbᵢᵀ / (dᵢ − J_cᵢ):
    near a limit, the natural gradient becomes parallel to the limit's boundary. The line search
    takes the first fraction with D_C ≤ δ that does not worsen the loss.

    A policy above a limit recovers: it takes steps like those of `TRPOStep` that lower E[ρ A_c],
    until J_c is (1 − `hysteresis`) d below its target, which is d minus a margin if there is one.
    Barriers of other costs stay active. If the policy recovers from several costs, the one that
    exceeds its limit most is lowered first. A limit of 0 has no barrier, and a batch without any
    cost starts no recovery.

    The diagnostics also have ``recovers``, [k]: 1 for the costs from which the policy recovers.

    Args:
        loss: A `CPOLoss`, or a callable of your own that returns a TensorDict with scalars
            ``loss_…`` and the differentiable ``cost_surrogate``, [k].
        cost_limits: d, as of a multiplier; see `parse_cost_limits`.
        beta: Weight β of the barrier, per unit of an episode's undiscounted cost, for every cost.
        hysteresis: Share of d at which a recovery ends; 1 ends it at the limit.
        settings: Settings of every trust-region step, see `TRPOStep`.

    Examples:
        >>> from safe_rl.models import make_actor
        >>> from safe_rl.objectives import CPOLoss
        >>> actor = make_actor(3, 2, hidden_sizes=[16], initial_log_std=-0.5)
        >>> region = {"beta": 0.1, "hysteresis": 0.8, "target_kl": 0.01, "damping": 0.1}
        >>> search = {"cg_iterations": 10, "backtrack_coeff": 0.8, "max_backtracks": 10}
        >>> step = CTRPOStep(CPOLoss(actor, entropy_coeff=0.0), {"cost": 25.0}, **region, **search)
        >>> step.recovered  # J_c - d at which a recovery ends
        tensor([-5.])
    """

    state_names = ("recovering",)

    def __init__(
        self,
        loss: Loss,
        cost_limits: CostLimits,
        *,
        beta: NonNegativeFloat,
        hysteresis: Fraction,
        **settings: Any,
    ) -> None:
        super().__init__(loss, **settings)
        self.cost_keys, self.limits = parse_cost_limits(cost_limits)
        self.beta = beta
        self.recovered = -(1 - hysteresis) * self.limits
        self.recovering = torch.zeros_like(self.limits, dtype=torch.bool)

    def _propose(
        self, losses: TensorDictBase, fisher: FisherProduct, limits: LimitState | None
    ) -> Proposal:
        surrogates, state = cost_surrogates(losses), require_limits(limits)
        state.check(self.cost_keys)
        length = state.length_for(surrogates)
        violation = state.required_decrease_for(surrogates)
        is_above = violation >= self.recovered.to(violation)
        was_recovering = self.recovering.to(violation.device) & is_above
        costs_anything = violation > -self.limits.to(violation)
        self.recovering = ((violation >= 0) | was_recovering) & costs_anything
        inside = ~self.recovering & (violation < 0)
        slack, start = -violation[inside], length * surrogates[inside].detach()
        worst = int(violation.masked_fill(~self.recovering, -torch.inf).argmax())
        recovers = self.recovering.any()
        objective = (lambda of: of["cost_surrogate"][worst]) if recovers else finite_sum
        loss = objective(losses)
        g = flat_gradient(loss, self.parameters, retain_graph=True)
        b = self._gradients(surrogates[inside])
        v, w = self._solve_all(fisher, g, b)
        # Woodbury's identity for the inverse of H + Σ κᵢbᵢbᵢᵀ, whatever the size of κ
        root = (self.beta * length**2 / slack).sqrt()
        gram = torch.eye(len(root), dtype=root.dtype, device=root.device)
        gram = gram + root[:, None] * (b @ w.T) * root
        direction = v - (root * torch.linalg.solve(gram, root * (b @ v))) @ w
        before = loss.detach()

        def is_acceptable(after: TensorDictBase, kl: Tensor) -> bool:
            change = length * after["cost_surrogate"][inside] - start
            divergence = kl + self.beta * barrier_divergence(change, slack).sum()
            return bool((divergence <= self.target_kl) & (objective(after) <= before))

        diagnostics = {"recovers": self.recovering.to(surrogates.dtype)}
        return Proposal(self._longest(direction, g), is_acceptable, diagnostics)


class CRPOStep(TRPOStep):
    """A step for the reward if all costs are at most d + η, else a step against one cost (CRPO).

    This is the algorithm of Xu, Liang and Lan 2021, with a trust region for the policy update. If
    J_cᵢ ≤ dᵢ + η for all i, it is a `TRPOStep` on the loss. Otherwise it is a `TRPOStep` on
    E[ρA_cᵢ] of the cost with the largest J_cᵢ − dᵢ. (The article takes any of the violated costs.)
    There is no multiplier, and only η to tune.

    The diagnostics also have ``reduces``, [k]: 1 for the cost that the step lowers.

    Args:
        loss: A `CPOLoss`, or a callable of your own that returns a TensorDict with scalars
            ``loss_…`` and the differentiable ``cost_surrogate``, [k].
        tolerance: Tolerated violation η, undiscounted cost per episode.
        settings: Settings of every trust-region step, see `TRPOStep`.

    Examples:
        >>> from safe_rl.models import make_actor
        >>> from safe_rl.objectives import CPOLoss
        >>> actor = make_actor(3, 2, hidden_sizes=[16], initial_log_std=-0.5)
        >>> search = {"cg_iterations": 10, "backtrack_coeff": 0.8, "max_backtracks": 10}
        >>> region = {"target_kl": 0.01, "damping": 0.1, **search}
        >>> step = CRPOStep(CPOLoss(actor, entropy_coeff=0.0), tolerance=2.0, **region)
    """

    def __init__(self, loss: Loss, *, tolerance: NonNegativeFloat, **settings: Any) -> None:
        super().__init__(loss, **settings)
        self.tolerance = tolerance

    def _propose(
        self, losses: TensorDictBase, fisher: FisherProduct, limits: LimitState | None
    ) -> Proposal:
        decrease = require_limits(limits).required_decrease_for(cost_surrogates(losses))
        worst = int(decrease.argmax())
        is_above = decrease[worst] > self.tolerance
        reduces = torch.zeros_like(decrease)
        reduces[worst] = is_above
        objective = (lambda of: of["cost_surrogate"][worst]) if is_above else finite_sum
        proposal = self._natural_step(losses, fisher, objective)
        return proposal._replace(diagnostics={"reduces": reduces})
