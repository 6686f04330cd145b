"""TRPO and CPO: losses against their definitions, steps against their own optimality."""

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
    perturb,
    whole_step,
)
from tensordict import TensorDict
from torch.distributions import Normal, kl_divergence

from safe_rl.algorithms import CPOStep, TRPOStep
from safe_rl.algorithms.trust_region_step import Proposal
from safe_rl.objectives import CPOLoss, LagrangeMultiplier, TRPOLagrangianLoss, TRPOLoss
from safe_rl.objectives.gae import normalise_advantages
from safe_rl.objectives.trust_region import FisherProduct, conjugate_gradient, flatten, policy_in

SETTINGS = TRUST_REGION | {"cg_iterations": 50}


def make_case(num_costs=1, batch_size=(400,)):
    actor = make_actor()
    batch = make_batch(actor, batch_size, num_costs)
    # Advantages that follow the actions, as sampled ones do, so that steps change surrogates.
    push = batch["action"] - batch["loc"]
    batch["advantage"] = push[..., :1] + 0.1 * batch["advantage"]
    if num_costs:
        batch["cost_advantage"] = 2 * push[..., :1] + push[..., 1:] + 0.1 * batch["cost_advantage"]
    return actor, normalise_advantages(batch)


def cpo_step(actor, **settings):
    return CPOStep(CPOLoss(actor, entropy_coeff=0.0), **(SETTINGS | settings))


def gradients_of(actor, batch):
    """Those of the loss, [P], and of the costs, [k, P]."""
    losses = CPOLoss(actor, entropy_coeff=0.0)(batch)
    g, *rows = flat_gradients(actor, losses["loss_objective"], *losses["cost_surrogate"])
    return g, torch.stack(rows)


def test_trpo_loss_is_the_definition():
    actor, batch = make_case(2)
    perturb(actor, 0.1)
    log_prob = actor.get_dist(batch.clone()).log_prob(batch["action"])
    ratio = (log_prob - batch["action_log_prob"]).exp().unsqueeze(-1)
    reward = (ratio * batch["advantage"]).mean()
    costs = (ratio * batch["cost_advantage"]).mean(0)
    multiplier = LagrangeMultiplier([25.0, 5.0], init=[0.5, 2.0], lr=0.05)
    weighed = -(reward - 0.5 * costs[0] - 2 * costs[1]) / 3.5
    for loss, expected in (
        (TRPOLoss(actor, entropy_coeff=0.01), -reward),
        (TRPOLagrangianLoss(actor, multiplier, entropy_coeff=0.01), weighed),
        (cpo := CPOLoss(actor, entropy_coeff=0.01), -reward),
    ):
        torch.testing.assert_close(loss(batch)["loss_objective"], expected)
    torch.testing.assert_close(cpo(batch)["cost_surrogate"], costs)


@pytest.mark.parametrize("batch_size", [(400,), (20, 20)])
def test_trpo_step_fills_the_trust_region_along_the_natural_gradient(batch_size):
    actor, batch = make_case(0, batch_size)
    parameters = list(actor.parameters())
    start = flatten(parameters).detach()
    matrix = dense_fisher(actor, batch).float()
    loss = TRPOLoss(actor, entropy_coeff=0.0)
    gradient = flatten(torch.autograd.grad(loss(batch)["loss_objective"], parameters))
    metrics = TRPOStep(loss, **SETTINGS)(batch)
    step = (flatten(parameters).detach() - start) / metrics["step_fraction"]
    length = 0.5 * step @ matrix @ step
    torch.testing.assert_close(length, torch.tensor(DELTA), rtol=1e-3, atol=0)
    assert torch.cosine_similarity(matrix @ step, -gradient, dim=0) > 0.999
    policy, past = policy_in(actor, batch).base_dist, Normal(batch["loc"], batch["scale"])
    kl = kl_divergence(policy, past).sum(-1).mean().detach()
    torch.testing.assert_close(metrics["kl"], kl, rtol=1e-3, atol=1e-6)
    assert 0.3 * DELTA < kl <= DELTA
    assert loss(batch)["loss_objective"] < 0
    assert metrics["step_fraction"] == pytest.approx(0.8 ** metrics["backtracks"].item())


def test_without_a_gradient_there_is_no_step():
    actor, batch = make_case(0)
    batch["advantage"].zero_()
    before = flatten(actor.parameters()).detach().clone()
    metrics = TRPOStep(TRPOLoss(actor, entropy_coeff=0.0), **SETTINGS)(batch)
    assert metrics["step_fraction"] == metrics["backtracks"] == metrics["kl"] == 0
    assert torch.equal(flatten(actor.parameters()), before)


@pytest.mark.parametrize("kind", [TRPOStep, CPOStep])
def test_rejected_step_leaves_the_policy_exactly_as_it_was(kind):
    actor, batch = make_case(0)
    before = flatten(actor.parameters()).detach().clone()

    def worse_everywhere(batch):
        value = sum(parameter.sum() for parameter in actor.parameters())
        moved = (flatten(actor.parameters()).detach() - before).norm()
        costs = (0 * value).unsqueeze(0)
        return TensorDict(loss_objective=value - value.detach() + moved, cost_surrogate=costs)

    step = kind(worse_everywhere, actor_network=actor, **SETTINGS)
    metrics = step(batch, limit_state(-5.0))
    assert metrics["step_fraction"] == 0
    assert metrics["backtracks"] == 10
    assert metrics["kl"] == 0
    assert torch.equal(flatten(actor.parameters()), before)


class OwnStep(TRPOStep):
    """A step of the same size for every parameter, and a criterion of the test's own."""

    def _propose(self, losses, fisher, limits):
        step = torch.full_like(flatten(self.parameters).detach(), 1e-5)
        return Proposal(step, self.is_acceptable, {})


@pytest.mark.parametrize(("answers", "fraction"), [([1], 1.0), ([0, 0, 1], 0.64), ([0] * 10, 0.0)])
def test_the_search_takes_the_first_acceptable_fraction(answers, fraction):
    actor, batch = make_case(0)
    before, left = flatten(actor.parameters()).detach().clone(), iter(answers)
    step = OwnStep(TRPOLoss(actor, entropy_coeff=0.0), **SETTINGS)
    step.is_acceptable = lambda losses, kl: bool(next(left))
    metrics = step(batch)
    assert metrics["step_fraction"].item() == pytest.approx(fraction)
    assert metrics["backtracks"] == len(answers) - (fraction > 0)
    moved = flatten(actor.parameters()) - before
    torch.testing.assert_close(moved, torch.full_like(moved, fraction * 1e-5), rtol=0, atol=1e-7)


def test_a_loss_that_fails_in_the_search_leaves_the_parameters():
    actor, batch = make_case(0)
    before = flatten(actor.parameters()).detach().clone()
    step = OwnStep(TRPOLoss(actor, entropy_coeff=0.0), **SETTINGS)
    step.is_acceptable = lambda losses, kl: 1 / 0
    with pytest.raises(ZeroDivisionError):
        step(batch)
    assert torch.equal(flatten(actor.parameters()), before)


def test_a_function_that_is_the_loss_is_lowered():
    actor, batch = make_case(0)

    def towards_zero(batch):
        return TensorDict(loss_mean=actor.get_dist(batch.clone()).mean.square().mean())

    start = towards_zero(batch)["loss_mean"]
    step = TRPOStep(towards_zero, actor_network=actor, **SETTINGS)
    for _ in range(30):
        step(batch)
    assert towards_zero(batch)["loss_mean"] < 0.1 * start


@pytest.mark.parametrize(("violation", "case"), [(-1e4, 3), (-5.0, 2), (5.0, 1), (1e4, 0)])
def test_cpo_cases_move_the_cost_as_they_should(violation, case):
    actor, batch = make_case(1)
    step = cpo_step(actor)
    before = step.loss(batch)["cost_surrogate"]
    metrics = step(batch, limit_state(violation))
    after = step.loss(batch)
    change = (after["cost_surrogate"] - before).item()
    assert metrics["case"] == case
    assert metrics["step_fraction"] > 0
    assert metrics["kl"] <= DELTA * 1.001
    assert change <= max(-violation / 100, 0) + 1e-6
    assert after["loss_objective"] < 0 or case < 2
    assert change < 0 or case > 1


def test_cpo_diagnostics_are_the_definitions():
    actor, batch = make_case(2)
    matrix = dense_fisher(actor, batch)
    g, b = gradients_of(actor, batch)
    violation = torch.tensor([-5.0, 3.0])
    metrics = cpo_step(actor)(batch, limit_state(*violation.tolist()))
    q, r = g @ torch.linalg.solve(matrix, g), b @ torch.linalg.solve(matrix, g)
    s = (b * torch.linalg.solve(matrix, b.T).T).sum(-1)
    c = violation.double() / 100
    expected = {
        "q": q, "r": r, "s": s, "c": c, "A": q - r**2 / s, "B": 2 * DELTA - c**2 / s
    }  # fmt: skip
    for name, value in expected.items():
        torch.testing.assert_close(metrics[name].double(), value, rtol=2e-3, atol=1e-4)
    assert metrics["case"] == 1
    assert metrics["nu"].shape == (2,)


@pytest.mark.parametrize("violation", [-1.0, 0.5, 3.0])
def test_unconverged_cpo_steps_meet_the_linear_constraints_and_the_radius(violation):
    """With ten iterations, against gradients and the dense Fisher matrix, not converged ones."""
    actor, batch = make_case(2, (2000,))
    parameters = list(actor.parameters())
    matrix = dense_fisher(actor, batch)
    g, b = gradients_of(actor, batch)
    step = cpo_step(actor, cg_iterations=3)
    violations = torch.tensor([violation, -1.0])
    fisher = FisherProduct(actor, batch, parameters, SETTINGS["damping"])
    solution = torch.linalg.solve(matrix, g)
    residual = matrix @ conjugate_gradient(fisher, g.float(), 3)[0].double() - g
    assert residual.norm() > 0.02 * g.norm()
    x, metrics = whole_step(step, batch, limit_state(*violations.tolist()))
    x = x.double()
    assert metrics["case"] in (1, 2)
    # the radius is spent, and no constraint exceeded, both to rounding
    assert (0.5 * x @ matrix @ x).item() == pytest.approx(DELTA, rel=1e-3)
    excess = (violations.double() / 100 + b @ x) / (
        2 * DELTA * (b @ matrix.inverse() @ b.T).diagonal()
    ).sqrt()
    assert excess.max().item() == pytest.approx(0.0, abs=1e-3)
    assert (g @ x).item() >= -((2 * DELTA * g @ solution).sqrt().item()) * 1.001


def test_a_bounded_demand_leaves_the_rest_of_the_step_to_the_reward():
    """In the metric of the dense Fisher matrix: 0.8 of the radius along b, 0.6 of it beside."""
    actor, batch = make_case(1, (2000,))
    matrix = dense_fisher(actor, batch)
    g, (b,) = gradients_of(actor, batch)

    def taken(violation, **settings):
        step = cpo_step(actor, cg_iterations=60, **settings)
        found, metrics = whole_step(step, batch, limit_state(violation))
        return found.double(), metrics

    step, found = taken(1e4, largest_required_decrease=0.8)
    radius = (2 * DELTA) ** 0.5
    w, v = torch.linalg.solve(matrix, b), torch.linalg.solve(matrix, g)
    along = w / (b @ w).sqrt()
    beside = v - (b @ v) / (b @ w) * w
    beside = beside / (beside @ matrix @ beside).sqrt()
    expected = -radius * (0.8 * along + 0.6 * beside)
    assert found["case"] == 1
    difference = step - expected
    assert (difference @ matrix @ difference).sqrt() < 0.02 * radius
    within_reach = 50 * radius * (b @ w).sqrt().item()
    assert torch.equal(
        taken(within_reach, largest_required_decrease=0.8)[0], taken(within_reach)[0]
    )
    assert taken(1e4)[1]["case"] == 0


def test_cpo_without_cost_gradient_is_trpo():
    actor, batch = make_case(1)
    batch["cost_advantage"].zero_()
    twin = make_actor()
    twin.load_state_dict(actor.state_dict())
    metrics = cpo_step(actor)(batch, limit_state(-25.0))
    TRPOStep(TRPOLoss(twin, entropy_coeff=0.0), **SETTINGS)(batch)
    assert metrics["case"] == 4
    torch.testing.assert_close(flatten(actor.parameters()), flatten(twin.parameters()))
    before = flatten(actor.parameters()).detach().clone()
    for settings in ({}, {"largest_required_decrease": 0.95}):  # of which none is in reach
        metrics = cpo_step(actor, **settings)(batch, limit_state(25.0))
        assert metrics["case"] == 0
        assert torch.equal(flatten(actor.parameters()), before)
        assert all(torch.as_tensor(value).isfinite().all() for value in metrics.values())


def test_errors_say_what_to_change():
    actor, batch = make_case(1)
    step = cpo_step(actor)
    with pytest.raises(ValueError, match="needs the state of the limits"):
        step(batch)
    with pytest.raises(ValueError, match="one column per limit"):
        step(batch, limit_state(0.0, 0.0))
    step = CPOStep(TRPOLoss(actor, entropy_coeff=0.0), **SETTINGS)
    with pytest.raises(ValueError, match="such as CPOLoss"):
        step(batch, limit_state(0.0))
    with pytest.raises(ValueError, match="pass the policy as actor_network"):
        TRPOStep(lambda batch: batch, **SETTINGS)


@pytest.mark.parametrize("entry", ["advantage", "cost_advantage", "observation", "action"])
def test_numbers_that_are_none_change_nothing(entry):
    actor, batch = make_case(1)
    batch[entry].view(-1)[0] = torch.inf if entry == "action" else torch.nan
    before = flatten(actor.parameters()).detach().clone()
    for step in (cpo_step(actor), TRPOStep(CPOLoss(actor, entropy_coeff=0.0), **SETTINGS)):
        read = entry in step.loss.in_keys
        with pytest.raises(FloatingPointError, match=f"'{entry}' is not finite in 1 of 400"):
            step(batch, limit_state(0.0))
        assert read
        assert torch.equal(flatten(actor.parameters()), before)
