"""Step of projection-based constrained policy optimisation (Yang et al. 2020)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, get_args

import scipy  # which loads its parts when they are asked for: half a second
import torch
from tensordict import TensorDictBase
from torch import Tensor

from safe_rl.algorithms.cpo_step import CPOStep
from safe_rl.algorithms.trust_region_step import Proposal, total_loss
from safe_rl.objectives.fisher import FisherProduct
from safe_rl.objectives.trust_region import flat_gradient
from safe_rl.ranges import Positive

__all__ = ["PCPOStep", "nearest_feasible"]

Projection = Literal["kl", "l2"]


def nearest_feasible(excess: Tensor, gram: Tensor) -> Tensor:
    """Multipliers of the projection onto half-spaces bᵢᵀx + cᵢ ≤ 0, in the metric L.

    The nearest point to x₀ is x₀ − Σᵢ νᵢ L⁻¹bᵢ, where ν ≥ 0 minimises ½ νᵀSν − νᵀe with
    e = b x₀ + c and Sᵢⱼ = bᵢᵀL⁻¹bⱼ. For one half-space, ν = max(0, e/s).

    Args:
        excess: e, [k].
        gram: S, [k, k]; positive semi-definite. Constraints without a gradient are left out.

    Returns:
        ν, [k].

    Examples:
        >>> nearest_feasible(torch.tensor([2.0, -1.0]), torch.tensor([[4.0, 0.0], [0.0, 1.0]]))
        tensor([0.5000, 0.0000])
    """
    lengths = gram.double().diagonal().clamp_min(0).sqrt()
    scale = torch.where(lengths > 1e-8, 1 / lengths, 0.0)
    values, vectors = torch.linalg.eigh(gram.double() * scale[:, None] * scale)
    roots = values.clamp_min(0).sqrt()
    inverse = torch.where(roots > 1e-6, 1 / roots, 0.0)
    factor = roots[:, None] * vectors.T
    target = inverse * (vectors.T @ (scale * excess.double()))
    solution, _ = scipy.optimize.nnls(factor.cpu().numpy(), target.cpu().numpy())
    return (torch.from_numpy(solution).to(scale) * scale).to(excess)


class PCPOStep(CPOStep):
    """TRPO's step, then the nearest point that keeps the linearised constraints.

    With x₀ = −√(2δ/gᵀH⁻¹g) H⁻¹g and e = b x₀ + c (Yang et al. 2020; for one constraint)

        x = x₀ − max(0, e / bᵀL⁻¹b) L⁻¹b,  L = H (``"kl"``) or the identity (``"l2"``),

    and for several the nearest point that keeps them all (see `nearest_feasible`). From inside the
    limits a KL projection stays in the trust region. Other steps may leave it: they are shortened
    to it, because neither the Fisher matrix nor the gradients say anything of what is beyond. The
    line search then takes the first fraction with KL(π_θ ‖ π_k) ≤ δ and
    L_c(new) − L_c(old) ≤ max(−c, 0), and, where nothing was projected, a loss that is not worse.

    Adds to the diagnostics ``c`` and ``nu``, [k], and ``shortened``, the share of x that is left.

    Args:
        loss: as of a `CPOStep`.
        projection: Distance that the projection keeps small.
        rescale_violation: Whether to divide the violations by the episode length.
        largest_demand: Bound of every c, see `CPOStep`; None for none.
        settings: Those of every step, see `TRPOStep`.

    Raises:
        ValueError: if `projection` is neither of the two.

    Examples:
        >>> from tensordict import TensorDict
        >>> from safe_rl.models import make_actor
        >>> from safe_rl.objectives import CPOLoss
        >>> actor = make_actor(3, 2, hidden_sizes=[16], initial_log_std=-0.5)
        >>> with torch.no_grad():
        ...     batch = actor(TensorDict(observation=torch.randn(8, 3), batch_size=[8]))
        >>> batch["advantage"], batch["cost_advantage"] = torch.randn(8, 1), torch.randn(8, 1)
        >>> search = {"cg_iterations": 10, "backtrack_coeff": 0.8, "max_backtracks": 10}
        >>> settings = {"projection": "kl", "rescale_violation": True, "damping": 0.1, **search}
        >>> step = PCPOStep(CPOLoss(actor, entropy_coeff=0.0), target_kl=0.01, **settings)
        >>> metrics = step(batch, torch.tensor([-1e6]), torch.tensor(50.0))
        >>> metrics["nu"]  # far inside, TRPO's step
        tensor([0.])
    """

    def __init__(
        self,
        loss: Callable[[TensorDictBase], TensorDictBase],
        *,
        projection: Projection,
        rescale_violation: bool,
        largest_demand: Positive | None = None,
        **settings: Any,
    ) -> None:
        super().__init__(
            loss, rescale_violation=rescale_violation, largest_demand=largest_demand, **settings
        )
        if projection not in get_args(Projection):
            raise ValueError(f"projection must be one of {get_args(Projection)}: {projection!r}.")
        self.projection = projection

    def _propose(
        self,
        losses: TensorDictBase,
        fisher: FisherProduct,
        cost_violation: Tensor | None,
        episode_length: Tensor | None,
    ) -> Proposal:
        surrogates = losses["cost_surrogate"]
        c = self._constraint(surrogates, cost_violation, episode_length)
        g = flat_gradient(total_loss(losses), self.parameters, retain_graph=True)
        b = self._gradients(surrogates)
        v, w = self._solve_all(fisher, g, b)
        q, c = g @ v, self._bounded(c, (b * w).sum(-1))
        for_reward = torch.where(q > 0, (2 * self.target_kl / q).sqrt(), 0.0) * -v
        back = w if self.projection == "kl" else b
        nu = nearest_feasible(c + b @ for_reward, b @ back.T)
        step = for_reward - nu @ back
        length = step @ fisher(step)
        shortened = (2 * self.target_kl / length.clamp_min(1e-30)).sqrt().clamp_max(1.0)
        accepts = self._acceptance(losses, c, may_be_worse=nu.any())
        return Proposal(shortened * step, accepts, {"c": c, "nu": nu, "shortened": shortened})
