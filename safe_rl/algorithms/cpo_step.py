"""Steps with linearised constraints: CPO (Achiam et al. 2017) and PCPO (Yang et al. 2020)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import numpy as np
import scipy  # its parts are loaded on first use, which takes half a second
import torch
from pydantic import PositiveFloat
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
from safe_rl.objectives.cpo_dual import DualSolution, solve_dual
from safe_rl.objectives.limits import LimitState
from safe_rl.objectives.trust_region import FisherProduct, flat_gradient

#: Squared norm of a cost gradient below which a satisfied constraint is left out (case 4).
_NO_GRADIENT = 1e-8


class CPOStep(TRPOStep):
    """Step on a loss within a trust region and k linearised cost constraints.

    With g the gradient of the loss, bᵢ those of the cost surrogates and cᵢ the constraint
    violations, the step solves the CPO problem by its dual (see `cpo_dual`). The line search
    takes the first fraction with KL(π_θ ‖ π_k) ≤ δ and L_c(new) − L_c(old) ≤ max(−c, 0). In cases
    2 to 4, in which the policy keeps its limits, the loss must also not be worse.

    Args:
        loss: A `CPOLoss`, or a callable of your own that returns a TensorDict with scalars
            ``loss_…`` and the differentiable ``cost_surrogate``, [k].
        largest_required_decrease: Upper bound of every c, as a share of √(2δ bᵀH⁻¹b), which is the
            largest decrease of the surrogate within the trust region; None: no bound. Without it, a
            policy far above its limit takes recovery steps (case 0), which ignore the reward, until
            the limit is reached: a return learned in 20 updates is forgotten in as many. With 0.8
            and one constraint, √(1 − 0.8²) = 0.6 of the step are left for the reward.
        settings: Settings of every trust-region step, see `TRPOStep`.

    Examples:
        >>> from tensordict import TensorDict
        >>> from safe_rl.models import make_actor
        >>> from safe_rl.objectives import CPOLoss, LimitState
        >>> actor = make_actor(3, 2, hidden_sizes=[8], initial_log_std=-0.5)
        >>> with torch.no_grad():
        ...     batch = actor(TensorDict(observation=torch.randn(8, 3), batch_size=[8]))
        >>> batch["advantage"], batch["cost_advantage"] = torch.randn(8, 1), torch.randn(8, 1)
        >>> search = {"cg_iterations": 10, "backtrack_coeff": 0.8, "max_backtracks": 10}
        >>> settings = {"target_kl": 0.01, "damping": 0.1, **search}
        >>> step = CPOStep(CPOLoss(actor, entropy_coeff=0.0), **settings)
        >>> state = LimitState.of(cost=[0.0], limit=[25.0], length=50.0)
        >>> step(batch, state)["case"]
        tensor(3)
    """

    def __init__(
        self, loss: Loss, *, largest_required_decrease: PositiveFloat | None = None, **settings: Any
    ) -> None:
        super().__init__(loss, **settings)
        self.largest_required_decrease = largest_required_decrease

    def _propose(
        self, losses: TensorDictBase, fisher: FisherProduct, limits: LimitState | None
    ) -> Proposal:
        g, b, c = self._linearised(losses, require_limits(limits))
        # With its gradient set to 0, the dual leaves out a satisfied constraint (case 4).
        b = b * ~((b.square().sum(-1, keepdim=True) <= _NO_GRADIENT) & (c[:, None] < 0))
        v, w = self._solve_all(fisher, g, b)
        q, r, s = g @ v, w @ g, b @ w.T
        c = self._bounded(c, s.diagonal())
        dual = solve_dual(q, r, s, c, self.target_kl)
        step = -(dual.reward_coefficient * v + dual.cost_coefficient @ w)
        accepts = self._acceptance(losses, c, may_be_worse=dual.case < 2)
        return Proposal(step, accepts, self._diagnostics(q, r, s.diagonal(), c, dual))

    def _bounded(self, c: Tensor, s: Tensor) -> Tensor:
        """c, bounded by a share of the surrogates' largest decrease, [k]."""
        if self.largest_required_decrease is None:
            return c
        within_reach = (2 * self.target_kl * s.clamp_min(0)).sqrt()
        bounded = torch.minimum(c, self.largest_required_decrease * within_reach)
        return torch.where(within_reach > 0, bounded, c)  # without a gradient none is in reach

    @staticmethod
    def _acceptance(
        losses: TensorDictBase, c: Tensor, may_be_worse: Tensor
    ) -> Callable[[TensorDictBase, Tensor], bool]:
        """Criterion: costs rise by max(−c, 0) at most, and the loss only if `may_be_worse`."""
        before, cost_before = finite_sum(losses).detach(), losses["cost_surrogate"].detach()
        allowance = (-c).clamp_min(0)

        def is_acceptable(after: TensorDictBase, kl: Tensor) -> bool:
            not_worse = finite_sum(after) <= before
            within = (after["cost_surrogate"] - cost_before <= allowance).all()
            return bool((not_worse | may_be_worse) & within)

        return is_acceptable

    def _linearised(
        self, losses: TensorDictBase, limits: LimitState
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Gradients of the loss, [P], and of the surrogates, [k, P], and the violations c, [k]."""
        surrogates = cost_surrogates(losses)
        # b is the gradient of an average per time step, so c has to be one too
        c = limits.required_decrease_for(surrogates) / limits.length_for(surrogates)
        g = flat_gradient(finite_sum(losses), self.parameters, retain_graph=True)
        return g, self._gradients(surrogates), c

    def _diagnostics(
        self, q: Tensor, r: Tensor, s: Tensor, c: Tensor, dual: DualSolution
    ) -> dict[str, Tensor]:
        """Scalars, and vectors [k] with one entry per constraint; A and B are 0 where s is."""
        has_gradient = s > 0
        return {
            "q": q,
            "r": r,
            "s": s,
            "c": c,
            "A": torch.where(has_gradient, q - r.square() / s, 0.0),
            "B": torch.where(has_gradient, 2 * self.target_kl - c.square() / s, 0.0),
            "lambda": dual.lam,
            "nu": dual.nu,
            "case": dual.case,
        }


def nearest_feasible(excess: Tensor, gram: Tensor) -> Tensor:
    """Multipliers of the projection onto half-spaces bᵢᵀx + cᵢ ≤ 0, in the metric L.

    The nearest point to x₀ is x₀ − Σᵢ νᵢ L⁻¹bᵢ, where ν ≥ 0 minimises ½ νᵀSν − νᵀe with
    e = b x₀ + c and Sᵢⱼ = bᵢᵀL⁻¹bⱼ. For one half-space, ν = max(0, e/s). It is solved as a problem
    of least distance (Lawson and Hanson 1974, section 23.4), also if the bᵢ depend on each other.
    Constraints without a gradient are left out. ν, [k], is 0 if no point is in all half-spaces;
    `excess` is e, [k], and `gram` S, [k, k].
    """
    lengths = gram.double().diagonal().clamp_min(0).sqrt()
    scale = torch.where(lengths > 1e-8, 1 / lengths, 0.0)
    values, vectors = torch.linalg.eigh(gram.double() * scale[:, None] * scale)
    beyond = scale * excess.double()
    unit = beyond.abs().max().clamp_min(1e-300)
    rows = torch.cat([values.clamp_min(0).sqrt()[:, None] * vectors.T, beyond[None] / unit])
    last = np.eye(len(rows))[-1]
    solution = torch.from_numpy(scipy.optimize.nnls(rows.cpu().numpy(), last)[0]).to(scale)
    left = 1 - rows[-1] @ solution
    nu = torch.where(left > 1e-9, solution * unit / left, 0.0)
    return (nu * scale).to(excess)


class PCPOStep(CPOStep):
    """TRPO's step, followed by a projection onto the linearised constraints.

    With x₀ = −√(2δ/gᵀH⁻¹g) H⁻¹g and e = b x₀ + c (Yang et al. 2020; for one constraint)

        x = x₀ − max(0, e / bᵀL⁻¹b) L⁻¹b,  L = H (``"kl"``) or the identity (``"l2"``),

    and for several constraints the nearest point that keeps them all (see `nearest_feasible`). If
    the policy keeps its limits, a KL projection stays in the trust region. Other steps may leave
    it. They are shortened to its boundary, because the Fisher matrix and the gradients are valid
    only inside. The line search then takes the first fraction with KL(π_θ ‖ π_k) ≤ δ and L_c(new) −
    L_c(old) ≤ max(−c, 0). If nothing was projected, the loss must also not be worse.

    The diagnostics also have ``c`` and ``nu``, [k], and ``shortened``, the factor by which x was
    shortened.

    Args:
        loss: Loss with surrogates of the costs, as in `CPOStep`.
        projection: Distance that the projection minimises: ``"kl"`` or ``"l2"``.
        settings: Settings of a `CPOStep` and of every trust-region step, see `TRPOStep`.

    Examples:
        >>> from safe_rl.models import make_actor
        >>> from safe_rl.objectives import CPOLoss
        >>> actor = make_actor(3, 2, hidden_sizes=[16], initial_log_std=-0.5)
        >>> search = {"cg_iterations": 10, "backtrack_coeff": 0.8, "max_backtracks": 10}
        >>> settings = {"target_kl": 0.01, "damping": 0.1, **search}
        >>> step = PCPOStep(CPOLoss(actor, entropy_coeff=0.0), projection="kl", **settings)
    """

    def __init__(self, loss: Loss, *, projection: Literal["kl", "l2"], **settings: Any) -> None:
        super().__init__(loss, **settings)
        self.projection = projection

    def _propose(
        self, losses: TensorDictBase, fisher: FisherProduct, limits: LimitState | None
    ) -> Proposal:
        g, b, c = self._linearised(losses, require_limits(limits))
        v, w = self._solve_all(fisher, g, b)
        c = self._bounded(c, (b * w).sum(-1))
        for_reward = self._longest(v, g)
        back = w if self.projection == "kl" else b
        nu = nearest_feasible(c + b @ for_reward, b @ back.T)
        step = for_reward - nu @ back
        length = step @ fisher(step)
        shortened = (2 * self.target_kl / length.clamp_min(1e-30)).sqrt().clamp_max(1.0)
        accepts = self._acceptance(losses, c, may_be_worse=nu.any())
        return Proposal(shortened * step, accepts, {"c": c, "nu": nu, "shortened": shortened})
