"""The dual of CPO by bounds on all steps, and at its edges."""

import numpy as np
import pytest
import torch

from safe_rl.objectives.cpo_dual import solve_dual

DELTA = 0.01
RADIUS = np.sqrt(2 * DELTA)
DIMENSION = 6


def random_problems(num_problems, num_costs, seed):
    """Vectors g, b, c of problems in coordinates in which H is the identity.

    c is scaled so that boundaries cross the trust region, miss it, or lie beyond reach.
    """
    generator = np.random.default_rng(seed)
    g = generator.normal(size=(num_problems, DIMENSION)) * np.exp(
        generator.normal(size=(num_problems, 1))
    )
    b = generator.normal(size=(num_problems, num_costs, DIMENSION))
    reach = RADIUS * np.linalg.norm(b, axis=-1)
    c = reach * generator.uniform(-1.6, 1.2, size=(num_problems, num_costs))
    return g, b, c


def solve(g, b, c, dtype=torch.float64):
    """Dual solution and the step x of every problem, through q, r, S and c only."""
    inputs = (
        np.einsum("ni,ni->n", g, g),
        np.einsum("ni,nki->nk", g, b),
        np.einsum("nki,nli->nkl", b, b),
        c,
    )
    solution = solve_dual(*(torch.as_tensor(x, dtype=dtype) for x in inputs), DELTA)
    step = -solution.reward_coefficient.numpy()[:, None] * g
    step = step - np.einsum("nk,nki->ni", solution.cost_coefficient.numpy(), b)
    return solution, step


@pytest.mark.parametrize("num_costs", [1, 2, 3, 4])
def test_steps_are_optimal_and_what_is_called_infeasible_is(num_costs):
    """Each by a bound that holds for every x within the trust region.

    Optimal: no feasible x has gᵀx below νᵀc − |g + Σ νᵢbᵢ|² / 2λ − λδ (weak duality). Infeasible: x
    breaks a constraint if Σ νᵢ(cᵢ + bᵢᵀx) ≥ νᵀc − √2δ |Σ νᵢbᵢ| is above 0 (Farkas).
    """
    g, b, c = random_problems(3000, num_costs, seed=num_costs)
    solution, step = solve(g, b, c)
    nu, found = solution.nu.numpy(), (solution.case > 0).numpy()
    combined = np.einsum("nk,nki->ni", nu, b)
    assert (nu >= 0).all()
    assert ((nu * c).sum(-1) > RADIUS * np.linalg.norm(combined, axis=-1))[~found].all()
    reach = RADIUS * np.linalg.norm(b, axis=-1)
    assert ((c + np.einsum("ni,nki->nk", step, b)) / reach)[found].max() < 2e-6
    assert np.linalg.norm(step, axis=-1).max() < RADIUS * (1 + 1e-6)
    lam = np.where(found, solution.lam.numpy(), 1.0)
    bound = (nu * c).sum(-1) - ((g + combined) ** 2).sum(-1) / (2 * lam) - lam * DELTA
    lost = ((g * step).sum(-1) - bound) / (RADIUS * np.linalg.norm(g, axis=-1))
    np.testing.assert_allclose(lost[found], 0, atol=1e-5)
    assert 0 < (~found).sum() < len(g) / 2
    assert set(solution.case.tolist()) == {0, 1, 2, 3}


def one_problem(g, b, c):
    to_array = np.atleast_2d
    solution, step = solve(to_array(np.array(g, float)), np.array([b], float), to_array(c))
    for field in solution:
        assert field.isfinite().all()
    return solution, step[0]


G, E1, E2 = [1.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]
TRPO = -RADIUS * np.array(G) / np.sqrt(2)


@pytest.mark.parametrize(
    ("g", "b", "c", "case", "expected"),
    [
        # No gradient of the cost: the unconstrained step, unless the cost must come down.
        (G, [[0, 0, 0]], [-0.1], 4, TRPO),
        (G, [[0, 0, 0]], [0.0], 4, TRPO),
        (G, [[0, 0, 0]], [0.1], 0, [0, 0, 0]),
        (G, [[0, 0, 0], [0, 0, 0]], [-0.1, -0.2], 4, TRPO),
        # One boundary crosses the trust region, another one lies beyond it.
        (G, [E1, E2], [-0.05, -1.0], 2, TRPO),
        # A vanishing constraint next to a usable one.
        (G, [[0, 0, 0], E1], [-0.1, -1.0], 3, TRPO),
        (G, [[0, 0, 0], [-1, 0, 0]], [-0.1, 0.0], 1, [0, -RADIUS, 0]),
        # Parallel g and b: away from the boundary, towards it, and recovering along it.
        (E1, [E1], [-0.05], 2, [-RADIUS, 0, 0]),
        (E1, [[-1, 0, 0]], [-0.05], 2, [-0.05, 0, 0]),
        (E1, [[-1, 0, 0]], [0.05], 1, [0.05, 0, 0]),
        (E1, [[-1, 0, 0]], [0.0], 1, [0, 0, 0]),
        # No gradient of the reward.
        ([0, 0, 0], [E1], [-0.05], 2, [0, 0, 0]),
        ([0, 0, 0], [E1], [0.05], 1, [-0.05, 0, 0]),
        # Infeasible: straight to the boundary, as far as the trust region goes.
        (G, [E1], [1.0], 0, [-RADIUS, 0, 0]),
        (G, [E1, E2], [1.0, 1.0], 0, [-RADIUS / np.sqrt(2), -RADIUS / np.sqrt(2), 0]),
        (G, [E1, E2], [3.0, 4.0], 0, [-0.6 * RADIUS, -0.8 * RADIUS, 0]),
        (G, [E1, E2], [1.0, -1.0], 0, [-RADIUS, 0, 0]),
        # Contradicting constraints: towards the worse one, nowhere when they are equal.
        (G, [E1, [-1, 0, 0]], [0.5, 0.5], 0, [0, 0, 0]),
        (G, [E1, [-1, 0, 0]], [0.5, 0.1], 0, [-RADIUS, 0, 0]),
        # The same constraint twice.
        (G, [E1, E1], [0.05, 0.05], 1, [-np.sqrt(RADIUS**2 / 2)] * 2 + [0]),
        (G, [[-1, 0, 0], [-2, 0, 0]], [0.05, 0.1], 1, [0.05, -np.sqrt(RADIUS**2 - 0.05**2), 0]),
    ],
)
def test_degenerate_problems_end_in_a_defined_step(g, b, c, case, expected):
    solution, step = one_problem(g, b, c)
    assert solution.case.item() == case
    np.testing.assert_allclose(step, expected, atol=1e-5)


@pytest.mark.parametrize("size", [1e-3, 1e-6, 1e-9, 1e-12])
def test_shrinking_cost_gradients_stay_finite(size):
    for c in (-1e-3, 0.0, 1e-3):
        _, step = one_problem(G, [[size, 0, 0]], [c])
        assert np.linalg.norm(step) <= RADIUS * (1 + 1e-6)


def test_single_precision_inputs_of_nearly_parallel_gradients():
    g, b, c = random_problems(500, 2, seed=11)
    b[:, 0] = -g + 1e-4 * b[:, 0]
    b[:, 1] = b[:, 0] + 1e-4 * b[:, 1]
    solution, step = solve(g, b, c, torch.float32)
    assert np.isfinite(step).all()
    assert solution.lam.dtype == torch.float32
    # Rounding can lengthen a step that is a difference of large parts; line searches shorten it.
    assert np.median(np.linalg.norm(step, axis=-1)) < 1.1 * RADIUS


def test_more_constraints_than_memory_allows_are_refused():
    vectors = torch.eye(20, dtype=torch.float64)
    with pytest.raises(ValueError, match=r"20 limited costs: .* at most 16.*ppo_lagrangian"):
        solve_dual(torch.tensor(1.0), vectors[0], vectors, -vectors[0], 0.01)
