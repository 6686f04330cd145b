"""Every algorithm on a problem whose optimal constrained policy is known in closed form."""

import pytest
import samples
import torch
from cmdp import ONE, STEPS, TARGET, TWO, make_actor, train
from tabular import ONE_OF_THREE, TWO_COMPONENTS

from safe_rl.algorithms import CPOStep, CRPOStep, CTRPOStep, PCPOStep, TRPOStep
from safe_rl.objectives import (
    APPOLoss,
    CPOLoss,
    CUPLoss,
    FOCOPSLoss,
    IPOLoss,
    LimitState,
    P3OLoss,
    PIDMultiplier,
    PPOLagrangianLoss,
    PPOLoss,
    ProjectedMultiplier,
    RCPOLoss,
    TRPOLagrangianLoss,
    TRPOLoss,
)

pytestmark = pytest.mark.long

TARGET_KL = 0.1
TRUST_REGION = samples.TRUST_REGION | {"target_kl": 0.03, "cg_iterations": 10}
PPO = {"clip_epsilon": 0.2, "entropy_coeff": 0.0}


def ppo_update(loss, actor):
    """Adam passes over the batch until the policy has moved far enough."""
    adam = torch.optim.Adam(actor.parameters(), lr=0.01)

    def update(batch, state=None):
        loss.prepare(batch, state)
        for _ in range(10):
            losses = loss(batch)
            if losses["kl"] > 1.2 * TARGET_KL:
                break
            adam.zero_grad()
            sum(loss for key, loss in losses.items() if key.startswith("loss_")).backward()
            adam.step()

    return update


def state_of(cmdp, mean_costs):
    return LimitState.of(cost=mean_costs, limit=cmdp.limits, length=STEPS)


def multiplier_first(multiplier, update):
    def update_both(batch, mean_costs):
        state = LimitState.of(cost=mean_costs, limit=multiplier.limits)
        multiplier.update(state)
        update(batch, state)

    return update_both


def ppo(actor, cmdp):
    update = ppo_update(PPOLoss(actor, **PPO), actor)
    return lambda batch, _mean_costs: update(batch)


def pid_multiplier(cmdp):
    return PIDMultiplier(
        cmdp.cost_limits, init=1.0, kp=0.5, ki=0.05, kd=0.2,
        proportional_ema=0.5, derivative_ema=0.5, derivative_delay=2, scale="limit",
    )  # fmt: skip


def ppo_pid(actor, cmdp):
    multiplier = pid_multiplier(cmdp)
    update = ppo_update(PPOLagrangianLoss(actor, multiplier, **PPO), actor)
    return multiplier_first(multiplier, update)


def trpo(actor, cmdp):
    step = TRPOStep(TRPOLoss(actor, entropy_coeff=0.0), **TRUST_REGION)
    return lambda batch, _mean_costs: step(batch)


def trpo_pid(actor, cmdp):
    multiplier = pid_multiplier(cmdp)
    loss = TRPOLagrangianLoss(actor, multiplier, entropy_coeff=0.0)
    return multiplier_first(multiplier, TRPOStep(loss, **TRUST_REGION))


def cpo(actor, cmdp):
    step = CPOStep(CPOLoss(actor, entropy_coeff=0.0), **TRUST_REGION)
    return lambda batch, mean_costs: step(batch, state_of(cmdp, mean_costs))


def p3o(actor, cmdp):
    update = ppo_update(P3OLoss(actor, kappa=20.0, **PPO), actor)
    return lambda batch, mean_costs: update(batch, state_of(cmdp, mean_costs))


def appo(actor, cmdp):
    multiplier = projected_multiplier(cmdp)
    update = ppo_update(APPOLoss(actor, multiplier, sigma=2.0, **PPO), actor)

    def update_both(batch, mean_costs):
        multiplier.update(state := state_of(cmdp, mean_costs))
        update(batch, state)

    return update_both


def ipo(actor, cmdp):
    loss = IPOLoss(actor, kappa=0.01 * STEPS, max_weight=10.0, **PPO)
    update = ppo_update(loss, actor)
    return lambda batch, mean_costs: update(batch, state_of(cmdp, mean_costs))


def projected_multiplier(cmdp):
    return ProjectedMultiplier(cmdp.cost_limits, init=0.0, lr=0.1, highest=None)


def weighed(kind, **settings):
    """A loss that weighs costs by a multiplier."""

    def build(actor, cmdp):
        multiplier = pid_multiplier(cmdp)
        return multiplier_first(multiplier, ppo_update(kind(actor, multiplier, **settings), actor))

    return build


def crpo(actor, cmdp):
    step = CRPOStep(CPOLoss(actor, entropy_coeff=0.0), tolerance=0.0, **TRUST_REGION)
    return lambda batch, mean_costs: step(batch, state_of(cmdp, mean_costs))


def pcpo(actor, cmdp):
    step = PCPOStep(CPOLoss(actor, entropy_coeff=0.0), projection="kl", **TRUST_REGION)
    return lambda batch, mean_costs: step(batch, state_of(cmdp, mean_costs))


def c_trpo(actor, cmdp):
    barrier = {"beta": 0.1, "hysteresis": 1.0}
    loss = CPOLoss(actor, entropy_coeff=0.0)
    region = {**TRUST_REGION, "target_kl": 0.01}  # the size of a recovery is one step
    step = CTRPOStep(loss, cmdp.cost_limits, **barrier, **region)
    return lambda batch, mean_costs: step(batch, state_of(cmdp, mean_costs))


def cup(actor, cmdp):
    multiplier = pid_multiplier(cmdp)
    loss = CUPLoss(actor, multiplier, gamma=0.9, lmbda=0.3, entropy_coeff=0.0)
    improve, project = ppo_update(PPOLoss(actor, **PPO), actor), ppo_update(loss, actor)

    def update(batch, state):
        improve(batch)
        project(batch, state)

    return multiplier_first(multiplier, update)


UNCONSTRAINED = [ppo, trpo]
CONSTRAINED = [
    (ppo_pid, 120),
    (trpo_pid, 120),
    (cpo, 100),
    (p3o, 120),
    (appo, 120),
    (ipo, 120),
    (weighed(FOCOPSLoss, temperature=1.5, max_state_kl=TARGET_KL, entropy_coeff=0.0), 120),
    (weighed(RCPOLoss, **PPO), 120),
    (crpo, 150),
    (pcpo, 120),
    (c_trpo, 200),
    (cup, 120),
]


@pytest.mark.parametrize("algorithm", UNCONSTRAINED)
def test_unconstrained_algorithms_reach_the_target_and_violate(algorithm):
    actor = make_actor()
    mean = train(ONE, actor, algorithm(actor, ONE), epochs=60)[-20:].mean(0)
    torch.testing.assert_close(mean, TARGET, atol=0.05, rtol=0)
    assert (ONE.expected_costs(mean) > 1.5 * ONE.limits).all()


# Two limits take as long again: but for one algorithm of each kind that is a slow test.
@pytest.mark.parametrize(
    ("algorithm", "epochs", "cmdp"),
    [
        pytest.param(
            *row, cmdp, id=f"{row[0].__name__}-{name}",
            marks=[pytest.mark.slow] if cmdp is TWO and row[0] not in (ppo_pid, cpo) else [],
        )
        for name, cmdp in (("one", ONE), ("two", TWO))
        for row in CONSTRAINED
    ],
)  # fmt: skip
def test_constrained_algorithms_reach_the_boundary_at_the_optimum(algorithm, epochs, cmdp):
    actor = make_actor()
    mean = train(cmdp, actor, algorithm(actor, cmdp), epochs)[-50:].mean(0)
    # Within 8 % of the limits and 0.05 of the optimal mean, averaged over the last 50 epochs.
    torch.testing.assert_close(cmdp.expected_costs(mean), cmdp.limits, atol=0, rtol=0.08)
    torch.testing.assert_close(mean, cmdp.optimum, atol=0.05, rtol=0)


# Gradient steps of a multiplier circle round the optimum of a linear programme for ever, so that
# there are none of them here.
CHOICES = [(ONE_OF_THREE, trpo_pid), (TWO_COMPONENTS, cpo), (TWO_COMPONENTS, p3o)]


@pytest.mark.parametrize(("problem", "algorithm"), CHOICES)
def test_policies_of_choices_reach_the_boundary_at_the_optimum(problem, algorithm):
    actor = problem.make_actor()
    update = algorithm(actor, problem)
    found = train(problem, actor, update, 100, problem.rollout, problem.probabilities)
    torch.testing.assert_close(found[-40:].mean(0), torch.cat(problem.optimum), atol=0.06, rtol=0)
