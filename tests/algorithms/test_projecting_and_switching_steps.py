"""PCPO's projection against a solver, and the steps of PCPO and CRPO against their definitions."""

import numpy as np
import pytest
import torch
from samples import (
    DELTA,
    TRUST_REGION,
    dense_fisher,
    flat_gradients,
    limit_state,
    make_actor,
    make_batch,
    whole_step,
)
from scipy.optimize import minimize

from safe_rl.algorithms import CRPOStep, PCPOStep
from safe_rl.algorithms.cpo_step import nearest_feasible
from safe_rl.objectives import CPOLoss

SETTINGS = TRUST_REGION


def make_case():
    actor = make_actor(width=4)
    batch = make_batch(actor, (400,), 2)
    push = batch["action"] - batch["loc"]
    batch["advantage"] = push[..., :1] + 0.1 * batch["advantage"]
    batch["cost_advantage"] = 2 * push + push[..., :1] + 0.1 * batch["cost_advantage"]
    return actor, batch


@pytest.mark.parametrize("num_costs", [1, 2, 3])
def test_the_nearest_feasible_point_is_that_of_a_solver(num_costs):
    generator = np.random.default_rng(num_costs)
    for _ in range(10):
        root = generator.normal(size=(5, 5))
        metric = root @ root.T + 0.5 * np.eye(5)
        b, c = generator.normal(size=(num_costs, 5)), generator.normal(size=num_costs)
        start = generator.normal(size=5)
        solved = minimize(
            lambda x, start=start, metric=metric: (x - start) @ metric @ (x - start),
            start,
            constraints={"type": "ineq", "fun": lambda x, b=b, c=c: -(b @ x + c)},
            options={"ftol": 1e-12, "maxiter": 500},
        )
        back = np.linalg.solve(metric, b.T).T
        nu = nearest_feasible(torch.tensor(b @ start + c), torch.tensor(b @ back.T)).numpy()
        np.testing.assert_allclose(start - nu @ back, solved.x, atol=1e-4)


@pytest.mark.parametrize(
    ("excess", "gram", "nu"),
    [
        ([1.0, 3.0], [[2.0, 0.0], [0.0, 0.0]], [0.5, 0.0]),  # one without a gradient is left out
        ([2.0, -4.0], [[1.0, 1.0], [1.0, 1.0]], [2.0, 0.0]),  # two limits of the same cost
        ([1.0, 1.0], [[1.0, -1.0], [-1.0, 1.0]], [0.0, 0.0]),  # they contradict each other
    ],
)
def test_constraints_may_depend_on_each_other(excess, gram, nu):
    found = nearest_feasible(torch.tensor(excess), torch.tensor(gram))
    assert found.tolist() == pytest.approx(nu)


@pytest.mark.parametrize("projection", ["kl", "l2"])
@pytest.mark.parametrize(
    "violations", [(-1e4, -1e4), (-1.0, -1e4), (0.5, -1e4), (1e4, -1e4), (0.5, 2.0)]
)
def test_pcpo_is_the_equation_of_its_article(projection, violations):
    """With two limits the projection is the one whose multipliers are not negative."""
    actor, batch = make_case()
    matrix = dense_fisher(actor, batch)
    step = PCPOStep(CPOLoss(actor, entropy_coeff=0.0), projection=projection, **SETTINGS)
    losses = step.loss(batch)
    g, *gradients = flat_gradients(actor, losses["loss_objective"], *losses["cost_surrogate"])
    taken, metrics = whole_step(step, batch, limit_state(*violations))
    assert metrics["kl"] <= DELTA * 1.001
    h_g = torch.linalg.solve(matrix, g)
    first = -(2 * DELTA / (g @ h_g)).sqrt() * h_g
    b, c = torch.stack(gradients), torch.tensor(violations).to(first) / 100
    back = (torch.linalg.solve(matrix, b.T) if projection == "kl" else b.T).T
    projected = []
    for active in ([], [0], [1], [0, 1]):
        nu = torch.linalg.solve(b[active] @ back[active].T, b[active] @ first + c[active])
        point = first - nu @ back[active]
        if (nu >= 0).all() and (b @ point + c <= 1e-9).all():
            projected.append(point)
    (expected,) = projected
    expected = expected * (2 * DELTA / (expected @ matrix @ expected)).sqrt().clamp_max(1.0)
    torch.testing.assert_close(
        taken.double(), expected, atol=2e-3 * expected.abs().max(), rtol=1e-2
    )


@pytest.mark.parametrize(
    ("violation", "reduces"),
    [([1.9, -5.0], None), ([2.1, -5.0], 0), ([3.0, 9.0], 1), ([torch.nan, torch.nan], None)],
)
def test_crpo_switches_at_the_limit_and_its_tolerance(violation, reduces):
    actor, batch = make_case()
    step = CRPOStep(CPOLoss(actor, entropy_coeff=0.0), tolerance=2.0, **SETTINGS)
    before = step.loss(batch)
    metrics = step(batch, limit_state(*violation))
    after = step.loss(batch)
    assert metrics["step_fraction"] > 0
    assert 0.3 * DELTA < after["kl"] <= DELTA * 1.001
    if reduces is None:
        assert not metrics["reduces"].any()
        assert after["loss_objective"] < before["loss_objective"]
    else:
        assert metrics["reduces"].tolist() == [float(i == reduces) for i in range(2)]
        assert after["cost_surrogate"][reduces] < before["cost_surrogate"][reduces]
