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


def constrained(cmdp, update, multiplier=None):
    """Updates that get the state of the limits, as the multiplier does before."""

    def update_both(batch, mean_costs):
        state = LimitState.of(cost=mean_costs, limit=cmdp.limits, length=STEPS)
        if multiplier is not None:
            multiplier.update(state)
        update(batch, state)

    return update_both


def pid_multiplier(cmdp):
    return PIDMultiplier(
        cmdp.cost_limits, init=1.0, kp=0.5, ki=0.05, kd=0.2,
        proportional_ema=0.5, derivative_ema=0.5, derivative_delay=2, scale="limit",
    )  # fmt: skip


def projected_multiplier(cmdp):
    return ProjectedMultiplier(cmdp.cost_limits, init=0.0, lr=0.1, highest=None)


def weighed(kind, make_multiplier=pid_multiplier, **settings):
    def build(actor, cmdp):
        multiplier = make_multiplier(cmdp)
        loss = kind(actor, multiplier, **settings)
        return constrained(cmdp, ppo_update(loss, actor), multiplier)

    return build


def penalised(kind, **settings):
    return lambda actor, cmdp: constrained(cmdp, ppo_update(kind(actor, **settings, **PPO), actor))


def step(kind, **settings):
    def build(actor, cmdp):
        given = (cmdp.cost_limits,) if kind is CTRPOStep else ()
        loss = CPOLoss(actor, entropy_coeff=0.0)
        return constrained(cmdp, kind(loss, *given, **(TRUST_REGION | settings)))

    return build


def trpo_pid(actor, cmdp):
    multiplier = pid_multiplier(cmdp)
    loss = TRPOLagrangianLoss(actor, multiplier, entropy_coeff=0.0)
    return constrained(cmdp, TRPOStep(loss, **TRUST_REGION), multiplier)


def cup(actor, cmdp):
    multiplier = pid_multiplier(cmdp)
    loss = CUPLoss(actor, multiplier, gamma=0.9, lmbda=0.3, entropy_coeff=0.0)
    improve, project = ppo_update(PPOLoss(actor, **PPO), actor), ppo_update(loss, actor)

    def update(batch, state):
        improve(batch)
        project(batch, state)

    return constrained(cmdp, update, multiplier)


UNCONSTRAINED = {
    "ppo": lambda actor: ppo_update(PPOLoss(actor, **PPO), actor),
    "trpo": lambda actor: TRPOStep(TRPOLoss(actor, entropy_coeff=0.0), **TRUST_REGION),
}
FOCOPS = {"temperature": 1.5, "max_state_kl": TARGET_KL, "entropy_coeff": 0.0}
CONSTRAINED = {
    "ppo_pid": (weighed(PPOLagrangianLoss, **PPO), 120),
    "trpo_pid": (trpo_pid, 120),
    "cpo": (step(CPOStep), 100),
    "p3o": (penalised(P3OLoss, kappa=20.0), 120),
    "appo": (weighed(APPOLoss, projected_multiplier, sigma=2.0, **PPO), 120),
    "ipo": (penalised(IPOLoss, kappa=0.01 * STEPS, max_weight=10.0), 120),
    "focops": (weighed(FOCOPSLoss, **FOCOPS), 120),
    "rcpo": (weighed(RCPOLoss, **PPO), 120),
    "crpo": (step(CRPOStep, tolerance=0.0), 150),
    "pcpo": (step(PCPOStep, projection="kl"), 120),
    # the size of a recovery is one step
    "c_trpo": (step(CTRPOStep, beta=0.1, hysteresis=1.0, target_kl=0.01), 200),
    "cup": (cup, 120),
}


@pytest.mark.parametrize("name", UNCONSTRAINED)
def test_unconstrained_algorithms_reach_the_target_and_violate(name):
    actor = make_actor()
    update = UNCONSTRAINED[name](actor)
    mean = train(ONE, actor, lambda batch, _: update(batch), epochs=60)[-20:].mean(0)
    torch.testing.assert_close(mean, TARGET, atol=0.05, rtol=0)
    assert (ONE.expected_costs(mean) > 1.5 * ONE.limits).all()


def of_two_limits(name):
    """They take as long again: but for one algorithm of each kind that is a slow test."""
    return pytest.param(name, TWO, marks=[] if name in ("ppo_pid", "cpo") else pytest.mark.slow)


@pytest.mark.parametrize(
    ("name", "cmdp"), [*((n, ONE) for n in CONSTRAINED), *map(of_two_limits, CONSTRAINED)]
)
def test_constrained_algorithms_reach_the_boundary_at_the_optimum(name, cmdp):
    actor, (algorithm, epochs) = make_actor(), CONSTRAINED[name]
    mean = train(cmdp, actor, algorithm(actor, cmdp), epochs)[-50:].mean(0)
    # Within 8 % of the limits and 0.05 of the optimal mean, averaged over the last 50 epochs.
    torch.testing.assert_close(cmdp.expected_costs(mean), cmdp.limits, atol=0, rtol=0.08)
    torch.testing.assert_close(mean, cmdp.optimum, atol=0.05, rtol=0)


# Gradient steps of a multiplier circle round the optimum of a linear programme for ever, so that
# there are none of them here.
CHOICES = [(ONE_OF_THREE, "trpo_pid"), (TWO_COMPONENTS, "cpo"), (TWO_COMPONENTS, "p3o")]


@pytest.mark.parametrize(("problem", "name"), CHOICES)
def test_policies_of_choices_reach_the_boundary_at_the_optimum(problem, name):
    actor = problem.make_actor()
    update = CONSTRAINED[name][0](actor, problem)
    found = train(problem, actor, update, 100, problem.rollout, problem.probabilities)
    torch.testing.assert_close(found[-40:].mean(0), torch.cat(problem.optimum), atol=0.06, rtol=0)
