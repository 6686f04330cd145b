"""C-TRPO, PCPO and CRPO: their steps against definitions and a solver, and their recoveries."""

import math

import numpy as np
import pytest
import torch
from point_mass import PointMass
from run_configs import point_mass_config
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
from torch.distributions import Normal, kl_divergence

from safe_rl.algorithms import CRPOStep, CTRPOStep, OnPolicy, PCPOStep
from safe_rl.algorithms.cpo_step import nearest_feasible
from safe_rl.algorithms.recovery_steps import barrier_divergence
from safe_rl.objectives import CPOLoss
from safe_rl.objectives.trust_region import flatten, policy_in

BETA = 0.5
LENGTH = torch.tensor(100.0)


def make_case(num_costs=2):
    """Rewards and costs that push the same way, so that limits are in the way."""
    actor = make_actor(width=4)
    batch = make_batch(actor, (400,), num_costs)
    push = batch["action"] - batch["loc"]
    batch["advantage"] = push[..., :1] + 0.1 * batch["advantage"]
    batch["cost_advantage"] = push[..., :1] + 0.1 * batch["cost_advantage"]
    return actor, batch


def make_two_costs():
    actor, batch = make_case()
    batch["cost_advantage"] += 2 * (batch["action"] - batch["loc"])
    return actor, batch


def c_trpo(actor, num_costs=2, limits=None, **changed):
    loss = CPOLoss(actor, entropy_coeff=0.0)
    settings = TRUST_REGION | {"beta": BETA, "hysteresis": 0.8, "max_backtracks": 20} | changed
    return CTRPOStep(loss, limits or [25.0] * num_costs, **settings)


def bregman(new, old):
    """D_φ(new, old) of φ(x) = x log x, by its definition."""
    phi = {x: x * math.log(x) if x else 0.0 for x in (new, old)}
    return phi[new] - phi[old] - (math.log(old) + 1) * (new - old)


@pytest.mark.parametrize("slack", [0.1, 25.0])
def test_the_divergence_is_that_of_its_definition(slack):
    for share in (-3.0, -0.5, 1e-3, 0.3, 1.0):
        change = share * slack
        found = barrier_divergence(torch.tensor(change), torch.tensor(slack)).item()
        assert found == pytest.approx(bregman(slack - change, slack), rel=2e-3, abs=1e-9)
    assert barrier_divergence(torch.tensor(1.01 * slack), torch.tensor(slack)) == torch.inf
    far = torch.tensor(1e18)  # no barrier
    assert barrier_divergence(torch.tensor(5.0), far) == pytest.approx(0, abs=1e-9)


def test_the_step_is_the_natural_one_of_the_divergence():
    """Its Hessian by differentiating twice what it is the Hessian of."""
    actor, batch = make_case()
    violation = torch.tensor([-4.0, -0.3])
    parameters = list(actor.parameters())
    step = c_trpo(actor)
    losses = step.loss(batch)
    surrogates = losses["cost_surrogate"]
    policy, past = policy_in(actor, batch).base_dist, Normal(batch["loc"], batch["scale"])
    change = LENGTH * (surrogates - surrogates.detach())
    barrier = change + (-violation - change) * ((-violation - change) / -violation).log()
    divergence = kl_divergence(policy, past).sum(-1).mean() + BETA * barrier.sum()
    slope = flatten(torch.autograd.grad(divergence, parameters, create_graph=True))
    assert slope.abs().max() < 1e-5
    rows = [flatten(torch.autograd.grad(s, parameters, retain_graph=True)) for s in slope]
    matrix = torch.stack(rows).double() + 0.1 * torch.eye(len(rows))
    objective = losses["loss_objective"]
    g = flatten(torch.autograd.grad(objective, parameters, retain_graph=True)).double()
    h_g = torch.linalg.solve(matrix, g)
    expected = -(2 * DELTA / (g @ h_g)).sqrt() * h_g
    taken, _ = whole_step(step, batch, limit_state(*violation.tolist()))
    torch.testing.assert_close(
        taken.double(), expected, atol=5e-3 * expected.abs().max().item(), rtol=2e-2
    )


@pytest.mark.parametrize("violation", [-1e6, -25.0, -1.0, -0.01])
def test_a_step_stays_in_its_region_and_within_the_limits(violation):
    actor, batch = make_case(1)
    step = c_trpo(actor, 1)
    before = step.loss(batch)
    metrics = step(batch, limit_state(violation))
    after = step.loss(batch)
    change = LENGTH * (after["cost_surrogate"] - before["cost_surrogate"]).detach()
    barrier = barrier_divergence(change, torch.tensor([-violation])).sum()
    assert metrics["step_fraction"] > 0
    divergence = after["kl"] + BETA * barrier
    assert divergence <= 1.001 * DELTA
    assert divergence > 0.2 * DELTA or violation == -0.01  # where the limit's curvature counts
    assert after["loss_objective"] < before["loss_objective"]
    assert change < -violation
    if violation == -1e6:
        assert change > 1.0  # what the limit is there to prevent
    if violation == -0.01:
        assert change < 0.02


def test_recoveries_begin_at_a_limit_and_end_below_it():
    actor, batch = make_case(1)
    step = c_trpo(actor, 1)
    seen = []
    for violation in (-1.0, 0.5, -1.0, -4.9, -5.1, -1.0, torch.nan):
        before = step.loss(batch)["cost_surrogate"]
        recovers = bool(step(batch, limit_state(violation))["recovers"])
        seen.append(recovers)
        assert not recovers or step.loss(batch)["cost_surrogate"] < before
        twin = c_trpo(actor, 1)
        twin.load_state_dict(step.state_dict())
        assert torch.equal(twin.recovering, step.recovering)
        step = twin
    assert seen == [False, True, True, True, False, False, True]


def test_of_several_costs_the_worst_is_recovered_within_the_limits_of_the_others():
    actor, batch = make_case(3)
    batch["cost_advantage"] = batch["cost_advantage"] * torch.tensor([1.0, 1.0, -1.0])
    step = c_trpo(actor, 3)
    before = step.loss(batch)["cost_surrogate"].detach()
    metrics = step(batch, limit_state(3.0, 9.0, -0.2))
    change = LENGTH * (step.loss(batch)["cost_surrogate"].detach() - before)
    assert metrics["recovers"].tolist() == [1.0, 1.0, 0.0]
    assert change[1] < 0
    assert change[2] < 0.2


def test_a_cost_within_its_limit_comes_last_however_large_its_hysteresis():
    actor, batch = make_case(2)
    batch["cost_advantage"] = batch["cost_advantage"] * torch.tensor([1.0, -1.0])
    step = c_trpo(actor, limits=[5.0, 500.0])
    for other in (-20.0, 0.5, -20.0):  # at last it still recovers, and is no longer violated
        before = step.loss(batch)["cost_surrogate"].detach()
        metrics = step(batch, limit_state(1.0, other))
        assert metrics["recovers"][0]
        assert step.loss(batch)["cost_surrogate"][0] < before[0]
    assert metrics["recovers"][1]


def test_a_state_of_other_limits_is_refused():
    actor, batch = make_case()  # of two costs
    with pytest.raises(ValueError, match="One limit for each of"):
        c_trpo(actor)(batch, limit_state(-4.0))


def test_at_a_limit_of_nothing_a_policy_without_costs_learns_from_its_rewards():
    actor, batch = make_case(2)
    batch["cost_advantage"] = batch["cost_advantage"] * torch.tensor([0.0, 1.0])
    step = c_trpo(actor, limits=[0.0, 25.0])
    recovers = []
    for violation in (2.0, 0.0, 0.0):
        before = step.loss(batch)["loss_objective"]
        metrics = step(batch, limit_state(violation, -10.0))
        recovers.append(metrics["recovers"].tolist())
    assert recovers == [[1.0, 0.0], [0.0, 0.0], [0.0, 0.0]]
    assert step.loss(batch)["loss_objective"] < before


def test_ten_times_the_cost_of_an_episode_is_ten_times_the_barrier():
    """Costs, limits and T̄ ten times as large, at a tenth of β: the same step."""
    actor, batch = make_case(1)
    state = {name: value.clone() for name, value in actor.state_dict().items()}
    changed = []
    for times in (1.0, 10.0):
        actor.load_state_dict(state)
        c_trpo(actor, 1, beta=BETA / times)(batch, limit_state(-times, length=100.0 * times))
        changed.append(flatten(actor.parameters()).detach())
    torch.testing.assert_close(*changed)


def test_the_limit_of_a_share_of_episodes_is_what_recoveries_go_by():
    """Charges are at most w ε below their limit: a recovery that waits for more never ends."""
    ends = []
    for risk in ("risk=chance", "risk=mean"):
        given = ("algo=c_trpo", "cost_limits={cost: 25}", risk)
        config = point_mass_config(*given, minibatch_size=None)
        step = OnPolicy.from_config(config, PointMass(config.num_envs)).policy_update
        ends.append(step.recovered.item())
    assert ends == pytest.approx([-0.2 * 25.0 * 0.1, -0.2 * 25.0])


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
    actor, batch = make_two_costs()
    matrix = dense_fisher(actor, batch)
    step = PCPOStep(CPOLoss(actor, entropy_coeff=0.0), projection=projection, **TRUST_REGION)
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
    actor, batch = make_two_costs()
    step = CRPOStep(CPOLoss(actor, entropy_coeff=0.0), tolerance=2.0, **TRUST_REGION)
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
