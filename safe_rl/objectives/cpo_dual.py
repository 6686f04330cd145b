"""The dual of constrained policy optimisation, for any number of linear constraints.

The step x of CPO (Achiam et al. 2017, equation 10) solves

    minimise gᵀx  subject to  cᵢ + bᵢᵀx ≤ 0 for i = 1 … k  and  ½ xᵀHx ≤ δ,

and needs only the products of its vectors under the metric H⁻¹:
q = gᵀH⁻¹g, rᵢ = gᵀH⁻¹bᵢ and Sᵢⱼ = bᵢᵀH⁻¹bⱼ. Its optimum is x = −(v + Σᵢ νᵢ wᵢ)/λ with v = H⁻¹g and
wᵢ = H⁻¹bᵢ. To find the active constraints, all 2ᵏ sets of constraints are tried in one batch. Every
set has a closed-form candidate, and the best feasible candidate is the optimum.
"""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import torch
from torch import Tensor

from safe_rl.checks import SettingError

#: Largest number of constraints k, because memory and time grow with 2ᵏ: 1 GB and 2 s for 16.
_MOST_CONSTRAINTS = 16
#: Tolerance on constraints, in units of the radius of the trust region.
_FEASIBILITY = 1e-6
#: Smallest sine of the angle between the gradients of constraints that are active together.
_DEPENDENT = 1e-6
#: Share of the squared gradient outside the span of the active constraints that counts as 0.
_PARALLEL = 1e-8
#: bᵀH⁻¹b below which a constraint's gradient counts as zero.
_VANISHING = 1e-16
#: Ridge added to S in a recovery; without it, contradicting constraints give an infinite step.
_RIDGE = 1e-6


class DualSolution(NamedTuple):
    """Solution of the dual; the step is x = −(reward_coefficient·v + Σᵢ cost_coefficientᵢ·wᵢ).

    Attributes:
        case: Case of the problem, [...] int. 4: no constraint has a gradient; 3: the whole trust
            region is feasible; 2: a constraint's boundary crosses it, and the policy is feasible;
            1: a boundary crosses it, and the policy is infeasible; 0: no point of the trust region
            is feasible, and the step is a recovery, which ignores g.
        lam: λ, multiplier of the trust region, [...]; 0 in case 0.
        nu: ν, multipliers of the constraints, [..., k].
        reward_coefficient: 1/λ, or 0 if the constraints leave no component of g free, [...].
        cost_coefficient: ν/λ, [..., k]; finite in every case.
    """

    case: Tensor
    lam: Tensor
    nu: Tensor
    reward_coefficient: Tensor
    cost_coefficient: Tensor


class _Scaled(NamedTuple):
    """The problem in units in which g, every bᵢ and the radius of the trust region have length 1.

    `r`, `c`: [..., 1, k]; `S`: [..., 1, k, k]. Dimensions of size 1 are for the 2ᵏ sets of active
    constraints, `sets`: [2ᵏ, k] bool. `usable`: which constraints have a gradient, [..., 1, k].
    """

    r: Tensor
    S: Tensor
    c: Tensor
    usable: Tensor
    sets: Tensor


def solve_dual(q: Tensor, r: Tensor, S: Tensor, c: Tensor, delta: Tensor | float) -> DualSolution:
    """Solve the CPO step for batches of problems; see the module for the notation.

    The solution is never NaN. Cases in which g, b and c do not define a unique step:

    - g = 0, or g in the span of the active constraints: the shortest step to their boundary;
    - bᵢ = 0: the constraint is left out if cᵢ ≤ 0; otherwise nothing is feasible;
    - infeasible: a step towards the nearest point that satisfies all constraints; its length is the
      trust region's radius (with one constraint −√(2δ/s)·w). No step at all if no violated
      constraint has a gradient, or if their gradients cancel out exactly.

    Args:
        q: gᵀH⁻¹g, [...].
        r: gᵀH⁻¹bᵢ, [..., k].
        S: bᵢᵀH⁻¹bⱼ, [..., k, k].
        c: Constraint violations, [..., k]; negative if the constraint is satisfied.
        delta: Radius δ > 0 of the trust region in KL.

    Returns:
        A `DualSolution`, in the dtype of `q`. For k = 1 its cases and multipliers are those of
        Achiam et al. 2017, appendix 10.2.

    Raises:
        SettingError: If there are more than 16 constraints.
    """
    if r.shape[-1] > _MOST_CONSTRAINTS:
        raise SettingError(
            f"{r.shape[-1]} limited costs: CPO's step takes at most {_MOST_CONSTRAINTS}, because "
            "it tries all sets of them. Algorithms with multipliers, such as ppo_lagrangian, take "
            "any number."
        )
    delta = torch.as_tensor(delta, dtype=torch.float64, device=q.device)
    gradient = q.double().clamp_min(0).sqrt()
    lengths = S.double().diagonal(dim1=-2, dim2=-1).clamp_min(0).sqrt()
    radius = (2 * delta).sqrt()
    problem = _scale(gradient, r.double(), S.double(), c.double() / radius, lengths)
    reward, costs, ratio, is_feasible = _best_feasible(problem)
    # A violated constraint that no step changes makes the problem infeasible.
    is_feasible &= ~((lengths.square() <= _VANISHING) & (c > 0)).any(-1)
    reward = torch.where(is_feasible, reward, 0.0)
    costs = torch.where(is_feasible[..., None], costs, _recovery(problem))

    # Back to the units of g, b and H.
    safe_lengths = lengths.clamp_min(_VANISHING**0.5)
    alpha = torch.where(gradient > 0, radius * reward / gradient.clamp_min(1e-150), 0.0)
    beta = radius * costs / safe_lengths
    lam = torch.where(is_feasible, gradient / radius * ratio, 0.0)
    nu = torch.where(is_feasible[..., None], lam[..., None] * beta, beta)
    case = _case(problem, c, is_feasible)
    dtype = q.dtype
    return DualSolution(case, lam.to(dtype), nu.to(dtype), alpha.to(dtype), beta.to(dtype))


def _scale(gradient: Tensor, r: Tensor, S: Tensor, c: Tensor, lengths: Tensor) -> _Scaled:
    usable = lengths.square() > _VANISHING
    inverse = torch.where(usable, 1 / lengths, 0.0)
    sets = torch.tensor(list(product([False, True], repeat=r.shape[-1])), device=r.device)
    symmetric = 0.5 * (S + S.mT)
    return _Scaled(
        r=(r * inverse / gradient[..., None].clamp_min(1e-150))[..., None, :],
        S=(symmetric * inverse[..., None] * inverse[..., None, :])[..., None, :, :],
        c=(c * inverse)[..., None, :],
        usable=usable[..., None, :],
        sets=sets,
    )


def _solve_active(problem: _Scaled, right: Tensor, ridge: float) -> tuple[Tensor, Tensor]:
    """(S_aa + ridge)⁻¹ right_a for every set a: [..., 2ᵏ, k, m]; and which sets are solvable."""
    pairs = problem.sets[:, :, None] & problem.sets[:, None, :]
    identity = torch.eye(right.shape[-2], dtype=right.dtype, device=right.device)
    active = torch.where(pairs, problem.S + ridge * identity, identity)
    factor, failed = torch.linalg.cholesky_ex(active)
    pivots = factor.diagonal(dim1=-2, dim2=-1)
    solvable = (failed == 0) & (pivots > _DEPENDENT).all(-1)
    solvable = solvable & (problem.usable | ~problem.sets).all(-1)
    factor = torch.where(solvable[..., None, None], factor, identity)
    right = torch.where(problem.sets[..., None], right, 0.0)
    return torch.cholesky_solve(right, factor), solvable


def _best_feasible(problem: _Scaled) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Best feasible candidate: coefficients of its step −(t ĝ + B̂β), and λ in scaled units.

    Returns:
        t [...], β [..., k], λ [...], and whether any candidate is feasible [...].
    """
    right = torch.stack(torch.broadcast_tensors(problem.c, problem.r), -1)
    inverse, solvable = _solve_active(problem, right, ridge=0.0)
    to_boundary, of_gradient = inverse.unbind(-1)
    # A = q − rᵀS⁻¹r is the squared gradient outside the span of the active constraints, and
    # B = 2δ − cᵀS⁻¹c the squared length of a step that is left after they are met.
    a = 1 - (problem.r * of_gradient).sum(-1)
    b = 1 - (problem.c * to_boundary).sum(-1)
    reward = torch.where(a > _PARALLEL, (b.clamp_min(0) / a.clamp_min(_PARALLEL)).sqrt(), 0.0)
    costs = to_boundary - reward[..., None] * of_gradient
    slack = problem.c - reward[..., None] * problem.r - (costs[..., None, :] * problem.S).sum(-1)
    violation = torch.where(problem.usable, slack, -torch.inf).amax(-1)
    valid = solvable & (b >= -_FEASIBILITY) & (violation <= _FEASIBILITY)
    objective = torch.where(valid, -reward - (problem.r * costs).sum(-1), torch.inf)
    best = objective.argmin(-1, keepdim=True)
    lam = (a.clamp_min(0) / b.clamp_min(1e-12)).sqrt()
    reward, lam = (x.gather(-1, best).squeeze(-1) for x in (reward, lam))
    return reward, _take_set(costs, best), lam, valid.any(-1)


def _recovery(problem: _Scaled) -> Tensor:
    """β of a unit step −B̂β towards the nearest point that satisfies all constraints, [..., k]."""
    inverse, solvable = _solve_active(problem, problem.c[..., None], ridge=_RIDGE)
    nu = inverse.squeeze(-1)
    valid = solvable & (nu >= 0).all(-1)
    gain = torch.where(valid, (problem.c * nu).sum(-1), -torch.inf)
    nu = _take_set(nu, gain.argmax(-1, keepdim=True))
    length = (nu * (problem.S.squeeze(-3) @ nu[..., None]).squeeze(-1)).sum(-1, keepdim=True)
    length = length.clamp_min(0).sqrt()
    return torch.where(length > _RIDGE, nu / length.clamp_min(_RIDGE), 0.0)


def _take_set(values: Tensor, index: Tensor) -> Tensor:
    """Values [..., 2ᵏ, k] of the set at index [..., 1]."""
    index = index[..., None].expand(*index.shape, values.shape[-1])
    return values.gather(-2, index).squeeze(-2)


def _case(problem: _Scaled, c: Tensor, is_feasible: Tensor) -> Tensor:
    usable = problem.usable.squeeze(-2)
    crosses = usable & (problem.c.squeeze(-2).square() <= 1)
    inside = ((c < 0) | ~usable).all(-1)
    case = torch.where(inside, torch.where(crosses.any(-1), 2, 3), 1)
    case = torch.where(usable.any(-1), case, 4)
    return torch.where(is_feasible, case, 0)
