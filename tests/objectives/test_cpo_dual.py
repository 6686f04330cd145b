"""The dual of CPO against scipy, against the two-branch formula for k = 1, and at its edges."""

import numpy as np
import pytest
import torch
from scipy.optimize import minimize

from safe_rl.objectives.cpo_dual import solve_dual

DELTA = 0.01
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
    reach = np.sqrt(2 * DELTA) * np.linalg.norm(b, axis=-1)
    c = reach * generator.uniform(-1.6, 1.2, size=(num_problems, num_costs))
    return g, b, c


def solve(g, b, c):
    """Dual solution and the step x of every problem, through q, r, S and c only."""
    inputs = (
        np.einsum("ni,ni->n", g, g),
        np.einsum("ni,nki->nk", g, b),
        np.einsum("nki,nli->nkl", b, b),
        c,
    )
    solution = solve_dual(*map(torch.as_tensor, inputs), DELTA)
    step = -solution.reward_coefficient.numpy()[:, None] * g
    step = step - np.einsum("nk,nki->ni", solution.cost_coefficient.numpy(), b)
    return solution, step


def scipy_step(g, b, c):
    """The same problem for a general solver, scaled to a unit ball; None if it is infeasible."""
    radius = np.sqrt(2 * DELTA)
    g = g / np.linalg.norm(g)
    scale = np.linalg.norm(b, axis=-1, keepdims=True)
    b, c = b / scale, c / (scale[:, 0] * radius)
    constraints = [
        {"type": "ineq", "fun": lambda x: -c - b @ x, "jac": lambda x: -b},
        {"type": "ineq", "fun": lambda x: 1 - x @ x, "jac": lambda x: -2 * x},
    ]
    # The problem is convex: where the solver converges to a feasible point, that is the optimum.
    # It may also stop at a point that its line search cannot improve; then the best start counts.
    stopped = []
    for start in (-g, -b.sum(0) / np.linalg.norm(b.sum(0)), np.zeros(DIMENSION)):
        result = minimize(
            lambda x: g @ x, start, jac=lambda x: g, method="SLSQP", constraints=constraints,
            options={"maxiter": 200, "ftol": 1e-10},
        )  # fmt: skip
        if max((c + b @ result.x).max(), result.x @ result.x - 1) < 1e-6:
            stopped.append(radius * result.x)
            if result.success:
                return stopped[-1]
    return min(stopped, key=g.__matmul__, default=None)


@pytest.mark.parametrize(("num_costs", "num_problems"), [(1, 800), (2, 600), (3, 200)])
def test_step_against_a_general_solver(num_costs, num_problems):
    g, b, c = random_problems(num_problems, num_costs, seed=num_costs)
    solution, step = solve(g, b, c)
    infeasible = 0
    for i in range(num_problems):
        expected = scipy_step(g[i], b[i], c[i])
        if expected is None:
            infeasible += 1
            assert solution.case[i] == 0
        else:
            assert solution.case[i] > 0
            np.testing.assert_allclose(step[i], expected, atol=2e-5)
    assert 0 < infeasible < num_problems / 2
    assert set(solution.case.tolist()) == {0, 1, 2, 3}


def textbook_dual(q, r, s, c):
    """λ, ν and case for one constraint, by the two branches of the spec of CPO."""
    a, b = q - r**2 / s, 2 * DELTA - c**2 / s
    if b < 0:
        return (0.0, np.sqrt(2 * DELTA / s), 0) if c >= 0 else (np.sqrt(q / (2 * DELTA)), 0.0, 3)

    def on_a(lam):
        return -0.5 * (a / lam + b * lam) - r * c / s

    def on_b(lam):
        return -0.5 * (q / lam + 2 * DELTA * lam)

    edge, top = r / c, 1e12
    # Λ_a = {λc − r > 0} and Λ_b = {λc − r ≤ 0} as intervals of λ ≥ 0.
    if c < 0:
        interval_a, interval_b = (0, edge), (max(edge, 0), top)
    else:
        interval_a, interval_b = (max(edge, 0), top), (0, edge)
    candidates = []
    for value, optimum, (low, high) in (
        (on_a, np.sqrt(a / b), interval_a), (on_b, np.sqrt(q / (2 * DELTA)), interval_b)
    ):  # fmt: skip
        if high > low:
            lam = np.clip(optimum, low, high)
            candidates.append((value(max(lam, 1e-12)), lam))
    lam = max(candidates)[1]
    return lam, max(0, lam * c - r) / s, 2 if c < 0 else 1


def test_one_constraint_against_the_two_branches_of_the_dual():
    g, b, c = random_problems(5000, 1, seed=7)
    solution, _ = solve(g, b, c)
    q, r = (g * g).sum(-1), (g * b[:, 0]).sum(-1)
    s = (b[:, 0] ** 2).sum(-1)
    expected = [textbook_dual(*problem) for problem in zip(q, r, s, c[:, 0], strict=True)]
    lam, nu, case = map(np.array, zip(*expected, strict=True))
    assert np.bincount(case).tolist() == np.bincount(solution.case).tolist()
    assert (np.bincount(case) > 300).all()
    np.testing.assert_array_equal(solution.case, case)
    np.testing.assert_allclose(solution.lam, lam, rtol=1e-6)
    np.testing.assert_allclose(solution.nu[:, 0], nu, rtol=1e-6, atol=1e-8)


def test_step_is_minus_natural_gradient_plus_multipliers_over_lambda():
    g, b, c = random_problems(200, 3, seed=3)
    solution, step = solve(g, b, c)
    rows = (solution.case > 0).numpy()
    lam, nu = solution.lam.numpy()[rows, None], solution.nu.numpy()[rows]
    expected = -(g[rows] + np.einsum("nk,nki->ni", nu, b[rows])) / lam
    np.testing.assert_allclose(step[rows], expected, rtol=1e-5, atol=1e-8)
    assert (nu >= 0).all()


def one_problem(g, b, c):
    to_array = np.atleast_2d
    solution, step = solve(to_array(np.array(g, float)), np.array([b], float), to_array(c))
    for field in solution:
        assert field.isfinite().all()
    return solution, step[0]


G, E1, E2 = [1.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]
RADIUS = np.sqrt(2 * DELTA)
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
    inputs = (
        np.einsum("ni,ni->n", g, g),
        np.einsum("ni,nki->nk", g, b),
        np.einsum("nki,nli->nkl", b, b),
        c,
    )
    solution = solve_dual(*(torch.as_tensor(x, dtype=torch.float32) for x in inputs), DELTA)
    step = -solution.reward_coefficient.numpy()[:, None] * g
    step = step - np.einsum("nk,nki->ni", solution.cost_coefficient.numpy(), b)
    assert np.isfinite(step).all()
    assert solution.lam.dtype == torch.float32
    # Rounding can lengthen a step that is a difference of large parts; line searches shorten it.
    assert np.median(np.linalg.norm(step, axis=-1)) < 1.1 * RADIUS
