"""Losses of first-order methods, against the equations and optima of their own articles."""

import math
from dataclasses import replace

import pytest
import torch
from one_state import minimise, one_state
from samples import assert_gradients_are_differences, limit_state, make_actor, make_batch, perturb
from tensordict import TensorDict

from safe_rl.objectives import (
    APPOLoss,
    CPOLoss,
    FOCOPSLoss,
    IPOLoss,
    LimitState,
    P3OLoss,
    PPOLagrangianLoss,
    PPOLoss,
    ProjectedMultiplier,
    RCPOLoss,
    TRPOLagrangianLoss,
)
from safe_rl.objectives.penalties import log_barrier

CLIP = {"clip_epsilon": 0.2, "entropy_coeff": 0.01}
FREE = {"clip_epsilon": 1.0, "entropy_coeff": 0.0}


def told(loss, *violation, **known):
    """The loss, which knows the state of the limits."""
    loss.prepare(TensorDict(), limit_state(*violation, **known))
    return loss


def projected(*values):
    limits = [25.0] * len(values)
    return ProjectedMultiplier(limits, init=list(values), lr=0.01, highest=None)


LOSSES = {
    "p3o": lambda actor: told(P3OLoss(actor, kappa=3.0, **CLIP), 60.0, -90.0),
    "ipo": lambda actor: told(IPOLoss(actor, kappa=10.0, max_weight=2.0, **CLIP), -200.0, 30.0),
    "appo": lambda actor: told(
        APPOLoss(actor, projected(0.5, 2.0), sigma=3.0, **CLIP), 0.2, -0.3, unit=[1.0, 2.0]
    ),
    "divergence": lambda actor: FOCOPSLoss(
        actor, projected(0.5, 2.0), temperature=1.5, max_state_kl=0.05, entropy_coeff=0.01
    ),
    "rcpo": lambda actor: RCPOLoss(actor, projected(0.5, 2.0), **CLIP),
    "ppo": lambda actor: PPOLagrangianLoss(actor, projected(0.5, 2.0), **CLIP),
    "trpo": lambda actor: TRPOLagrangianLoss(actor, projected(0.5, 2.0), entropy_coeff=0.01),
    "cpo": lambda actor: CPOLoss(actor, entropy_coeff=0.01),
}


@pytest.mark.parametrize("name", LOSSES)
def test_gradients_against_finite_differences(name):
    actor = make_actor(width=4)
    batch = make_batch(actor, [4, 8], 2).double()
    actor.double()
    perturb(actor, 0.1)
    loss = LOSSES[name](actor).double()

    def trained():
        return sum(value.sum() for value in loss(batch).values() if value.requires_grad)

    assert_gradients_are_differences(trained, actor)


@pytest.mark.long
@pytest.mark.parametrize("name", sorted({*LOSSES} - {"ppo", "trpo"}))  # see test_ppo
def test_they_compile(name):
    torch._dynamo.reset()
    actor = make_actor()
    batch = make_batch(actor, [16], 2)
    perturb(actor, 0.1)
    loss = LOSSES[name](actor)
    # before compiling: torch finds the function of a divergence once, which Dynamo cannot trace
    expected = dict(loss(batch))
    compiled = torch.compile(loss, fullgraph=True, backend="eager")(batch)
    torch.testing.assert_close(dict(compiled), expected)


@pytest.mark.parametrize("name", LOSSES)
def test_they_take_masks_leave_batches_and_report_what_they_name(name):
    actor = make_actor()
    batch = make_batch(actor, [16], 2)
    perturb(actor, 0.1)
    loss, before = LOSSES[name](actor), batch.clone()
    expected = loss(batch)
    assert set(expected.keys()) == set(loss.out_keys)
    learned = {key for key, value in expected.items() if value.requires_grad}
    # the step of CPO differentiates cost surrogates
    assert name == "cpo" or all(key.startswith("loss_") for key in learned)
    assert set(batch.keys()) == set(before.keys())
    assert (batch == before).all()
    padded = TensorDict.cat([batch, torch.full_like(batch, 7.0)])
    padded["collector", "mask"] = torch.arange(32) < 16
    torch.testing.assert_close(dict(loss(padded)), dict(expected))


GAIN, COST = [1.0, 0.2, -1.2], [0.8, -0.1, -0.7]


def moved_case(*costs):
    """A policy that has gone to where costs are low, beyond the bounds of clipping."""
    actor, logits, batch = one_state(GAIN, *costs)
    with torch.no_grad():
        logits.copy_(torch.tensor([-1.0, -0.2, 0.5]))
    return actor, logits, batch


def test_p3o_adds_a_penalty_on_costs_that_are_clipped_to_their_pessimistic_side():
    actor, logits, batch = moved_case(COST, COST)
    ratio = logits.detach().softmax(0) * 3
    expected = 0.0
    for r, cost in zip(ratio.tolist(), COST, strict=True):
        expected += max(r * cost, min(max(r, 0.8), 1.2) * cost) / 3
    # a cost far below its limit makes up for none above
    losses = told(P3OLoss(actor, kappa=20.0, **CLIP), 20.0, -400.0)(batch)
    assert losses["cost_surrogate"].tolist() == pytest.approx([expected] * 2, abs=1e-6)
    assert losses["loss_penalty"].item() == pytest.approx(20 * (expected + 0.2), abs=1e-5)
    assert losses["loss_objective"] == PPOLoss(actor, **CLIP)(batch)["loss_objective"]


def test_ipo_adds_the_barrier_of_its_article_to_costs_that_are_not_clipped():
    """−(κ/T̄) log(−Δ/T̄ − E[ρ A_c]) with Δ = −60 and T̄ = 100."""
    actor, logits, batch = moved_case(COST)
    losses = told(IPOLoss(actor, kappa=20.0, max_weight=1e3, **CLIP), -60.0)(batch)
    expected = -0.2 * (0.6 - logits.detach().softmax(0) @ torch.tensor(COST)).log()
    torch.testing.assert_close(losses["loss_barrier"].detach(), expected)
    assert losses["loss_objective"] == PPOLoss(actor, **CLIP)(batch)["loss_objective"]


@pytest.mark.parametrize("violation", [2.0, -2.0])
def test_appo_has_the_gradient_of_the_augmented_lagrangian(violation):
    """max(0, λ + σΔ)² / 2σ with Δ the violation after the update, in units of the scale."""
    costs = torch.tensor([COST, [-1.0, 3.0, -2.0]])
    actor, logits, batch = one_state(GAIN, *costs.tolist())
    weights, unit = torch.tensor([0.5, 0.2]), torch.tensor([1.0, 7.0])
    loss = APPOLoss(actor, projected(0.5, 0.2), sigma=3.0, **FREE)
    loss.clip_epsilon.fill_(1e6)
    state = LimitState.of(cost=[10.0 + violation, 5.0], limit=[10.0, 4.0], length=20.0)
    losses = loss(loss.prepare(batch, replace(state, unit=unit)))
    found = torch.autograd.grad(losses["loss_objective"] + losses["loss_penalty"], logits)[0]
    policy = logits.softmax(0)
    inner = (weights + 3 * (state.violation + 20 * costs @ policy) / state.scale).clamp_min(0)
    penalty = (state.scale / unit / 20 * (inner.square() - weights.square()) / 6).sum()
    value = penalty - policy @ torch.tensor(GAIN)
    torch.testing.assert_close(found, torch.autograd.grad(value / 1.7, logits)[0])
    torch.testing.assert_close(losses["loss_penalty"], penalty / 1.7)
    torch.testing.assert_close(losses["cost_weight"], inner.detach())


def test_the_barrier_goes_on_smoothly_beyond_its_domain():
    slack = torch.tensor([5.0, 0.1, 0.05, 0.04999, 0.0, -3.0], requires_grad=True)
    barrier = log_barrier(slack, kappa=0.1, max_weight=2.0)
    (slope,) = torch.autograd.grad(barrier.sum(), slack)
    torch.testing.assert_close(barrier[:2], -0.1 * slack[:2].log())
    torch.testing.assert_close(slope, torch.tensor([-0.02, -1.0, -2.0, -2.0, -2.0, -2.0]))
    assert (barrier[2] - barrier[3]).abs() < 1e-4


def test_the_divergence_loss_has_the_optimum_of_the_trust_region():
    """π_k exp((A − ν A_c)/β) / Z, theorem 1 of its article."""
    advantage, costs = [1.0, 0.2, -1.2, 0.7], [0.8, -0.1, -0.7, 0.3]
    actor, logits, batch = one_state(advantage, costs)
    loss = FOCOPSLoss(actor, projected(0.6), temperature=1.5, max_state_kl=1e6, entropy_coeff=0.0)
    minimise(loss, logits, batch)
    expected = (torch.tensor(advantage) - 0.6 * torch.tensor(costs)).div(1.5).softmax(0)
    torch.testing.assert_close(logits.detach().softmax(0), expected, atol=1e-4, rtol=0)


def test_the_divergence_loss_learns_nothing_from_states_that_have_gone_too_far():
    actor, logits, batch = one_state(GAIN, COST)
    loss = FOCOPSLoss(actor, projected(0.6), temperature=1.5, max_state_kl=0.02, entropy_coeff=0.0)
    near = loss(batch)
    assert near["trusted_fraction"] == 1
    with torch.no_grad():
        logits.copy_(torch.tensor([1.0, 0.0, -1.0]))
    far = loss(batch)
    assert far["kl"] > 0.02
    assert far["trusted_fraction"] == far["loss_objective"] == 0
    assert not torch.autograd.grad(far["loss_objective"], logits)[0].any()


def test_rcpo_is_ppo_on_the_penalised_reward():
    """Whose advantage is A − λ A_c: estimates are linear in rewards and values."""
    actor = make_actor()
    batch = make_batch(actor, [4, 16], 2)
    perturb(actor, 0.2)
    found = RCPOLoss(actor, projected(0.5, 2.0), **CLIP)(batch)
    batch["advantage"] -= (batch["cost_advantage"] @ torch.tensor([0.5, 2.0])).unsqueeze(-1)
    expected = PPOLoss(actor, **CLIP)(batch)
    assert expected["clip_fraction"] > 0
    for key in expected.keys():  # noqa: SIM118
        torch.testing.assert_close(found[key], expected[key])


def test_projected_multipliers_move_by_the_violation_and_stop_at_their_bounds():
    multiplier = ProjectedMultiplier([25.0, 5.0], init=[0.0, 1.9], lr=0.01, highest=2.0)
    multiplier.update(limit_state(-5.0, 5.0))
    assert multiplier.value.tolist() == pytest.approx([0.0, 1.95])
    multiplier.update(limit_state(35.0, 55.0))
    assert multiplier.value.tolist() == pytest.approx([0.35, 2.0])
    multiplier.update(limit_state(torch.nan, -5.0))
    assert multiplier.value.tolist() == pytest.approx([0.35, 1.95])


def test_before_any_batch_the_policy_counts_as_at_its_limit():
    actor, _, batch = one_state(GAIN, COST, COST)
    loss = P3OLoss(actor, kappa=20.0, **FREE)
    with pytest.raises(ValueError, match=r"call prepare\(batch, limits\)"):
        loss.limits  # noqa: B018  # a loss of the user's reads it
    with pytest.raises(ValueError, match=r"call prepare\(batch, limits\)"):
        loss(batch)
    told(loss, torch.nan, torch.nan)
    loss.clip_epsilon.fill_(1e6)
    assert loss(batch)["loss_penalty"].abs() < 1e-5
    loss = told(IPOLoss(actor, kappa=50.0, max_weight=10.0, **FREE), torch.nan, torch.nan)
    loss.clip_epsilon.fill_(1e6)
    # the barrier's tangent at κ / (w T̄), extended to 0, of each cost
    expected = -0.5 * math.log(0.5 / 10.0) + 0.5
    assert loss(batch)["loss_barrier"].item() == pytest.approx(2 * expected, abs=1e-5)


def test_a_violation_without_the_length_of_episodes_is_refused():
    """Taken for no violation, it once made P3O ignore a cost of four times the limit."""
    actor, _, batch = one_state(GAIN, COST)
    loss = P3OLoss(actor, kappa=20.0, **FREE)
    loss.prepare(batch, LimitState.of(cost=[100.0], limit=[25.0]))
    with pytest.raises(ValueError, match="no episode length"):
        loss(batch)


def test_a_multiplier_that_would_weigh_nothing_is_refused():
    actor, _, batch = one_state(GAIN, COST)
    loss = PPOLoss(actor, **FREE)
    loss.multiplier = projected(0.5)
    with pytest.raises(TypeError, match=r"derive it from PPOLagrangianLoss, or .*WeighsCosts"):
        loss(batch)


def test_a_loss_that_reads_costs_without_saying_so_is_told_to():
    class Careless(PPOLoss):
        def _surrogates(self, tensordict, log_weight):
            return {"loss_objective": self._cost_advantage(tensordict)}

    actor, _, batch = one_state(GAIN, COST)
    loss = Careless(actor, **FREE)
    with pytest.raises(KeyError, match="Careless needs has_costs = True"):
        loss(batch.select(*loss.in_keys))  # as an update does


@pytest.mark.parametrize("name", LOSSES)
def test_every_agent_of_a_state_has_cost_advantages_of_its_own(name):
    """As many states as agents: nothing else would tell that one were taken for the other."""
    actor = make_actor()
    batch = make_batch(actor, [5, 5], 2)
    perturb(actor, 0.1)
    loss = LOSSES[name](actor)
    expected = loss(batch.flatten())
    batch.batch_size = [5]
    losses = loss(batch)
    for key in losses.keys():  # noqa: SIM118
        torch.testing.assert_close(losses[key], expected[key])
    batch["cost_advantage"] = torch.randn(5, 2)
    with pytest.raises(ValueError, match=r"expected \(5, 5, 2\)"):
        loss(batch)
