"""The algorithms on a problem whose optimal constrained policy is known in closed form."""

from itertools import count

import pytest
import torch
from cmdp import ONE, TARGET, TWO, make_actor, train

from safe_rl.objectives import LagrangeMultiplier, PPOLagrangianLoss, PPOLoss

TARGET_KL = 0.1
PPO = {"clip_epsilon": 0.2, "entropy_coeff": 0.0}


def ppo_update(loss, actor):
    """Adam passes over the batch until the policy has moved far enough."""
    adam = torch.optim.Adam(actor.parameters(), lr=0.01)

    def update(batch):
        for _ in range(10):
            losses = loss(batch)
            if losses["kl"] > 1.2 * TARGET_KL:
                break
            adam.zero_grad()
            losses["loss_objective"].backward()
            adam.step()

    return update


def dual_ascent(multiplier, update):
    """Multiplier first, then the policy; the dual step sizes fall as 1/t so that both settle."""
    first_lr, epochs = multiplier.lr, count(1)

    def update_both(batch, mean_costs):
        multiplier.lr = first_lr / (1 + next(epochs) / 50)
        multiplier.update(mean_costs)
        update(batch)

    return update_both


def ppo(actor, cmdp):
    update = ppo_update(PPOLoss(actor, **PPO), actor)
    return lambda batch, _mean_costs: update(batch)


def ppo_lagrangian(actor, cmdp):
    multiplier = LagrangeMultiplier(cmdp.cost_limits, init=1.0, lr=0.08)
    return dual_ascent(multiplier, ppo_update(PPOLagrangianLoss(actor, multiplier, **PPO), actor))


UNCONSTRAINED = [ppo]
CONSTRAINED = [ppo_lagrangian]


@pytest.mark.parametrize("cmdp", [ONE, TWO], ids=["one", "two"])
@pytest.mark.parametrize("algorithm", UNCONSTRAINED)
def test_unconstrained_algorithms_reach_the_target_and_violate(algorithm, cmdp):
    actor = make_actor()
    mean = train(cmdp, actor, algorithm(actor, cmdp), epochs=60)[-20:].mean(0)
    torch.testing.assert_close(mean, TARGET, atol=0.05, rtol=0)
    assert (cmdp.expected_costs(mean) > 1.5 * cmdp.limits).all()


@pytest.mark.parametrize("cmdp", [ONE, TWO], ids=["one", "two"])
@pytest.mark.parametrize("algorithm", CONSTRAINED)
def test_constrained_algorithms_reach_the_boundary_at_the_optimum(algorithm, cmdp):
    actor = make_actor()
    mean = train(cmdp, actor, algorithm(actor, cmdp), epochs=250)[-50:].mean(0)
    # Within 8 % of the limits and 0.05 of the optimal mean, averaged over the last 50 epochs.
    torch.testing.assert_close(cmdp.expected_costs(mean), cmdp.limits, atol=0, rtol=0.08)
    torch.testing.assert_close(mean, cmdp.optimum, atol=0.05, rtol=0)
