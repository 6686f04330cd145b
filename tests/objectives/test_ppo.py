"""PPO losses against loops written from the definition."""

import pytest
import torch
from samples import limit_state, make_actor, make_batch, perturb

from safe_rl.objectives.multipliers import LagrangeMultiplier
from safe_rl.objectives.policy_losses import PPOLagrangianLoss, PPOLoss

SETTINGS = {"clip_epsilon": 0.2, "entropy_coeff": 0.01}
LIMITS = {"a": 25.0, "b": 5.0}


def make_lagrangian(actor, init=(0.5, 2.0), limits=LIMITS, **settings):
    multiplier = LagrangeMultiplier(limits, init=init, lr=0.05)
    return PPOLagrangianLoss(actor, multiplier, **(SETTINGS | settings))


def gradient(loss, actor):
    return torch.autograd.grad(loss, list(actor.parameters()))


@pytest.mark.parametrize("clipping", ["none", "pessimistic"])
@pytest.mark.parametrize("batch_size", [[64], [4, 16]])
def test_lagrangian_from_the_definition(batch_size, clipping):
    actor = make_actor()
    batch = make_batch(actor, batch_size, 2)
    perturb(actor, 0.5)
    flat, total = batch.flatten(), 0.0
    with torch.no_grad():
        loss = make_lagrangian(actor, cost_clipping=clipping)(batch)["loss_objective"]
        log_prob = actor.get_dist(flat.clone()).log_prob(flat["action"])
    for i, ratio in enumerate((log_prob - flat["action_log_prob"]).exp().tolist()):
        near = min(max(ratio, 0.8), 1.2)
        gain, costs = flat["advantage"][i].item(), flat["cost_advantage"][i].tolist()
        bounds = near if clipping == "pessimistic" else ratio
        worst = [max(ratio * cost, bounds * cost) for cost in costs]
        total += min(ratio * gain, near * gain) - 0.5 * worst[0] - 2.0 * worst[1]
    assert loss.item() == pytest.approx(-total / 64 / 3.5, rel=1e-5)


@pytest.mark.parametrize("clipping", ["none", "pessimistic"])
@pytest.mark.parametrize("log_weight", [-80.0, -95.0, -200.0])
def test_an_action_that_has_become_impossible_leaves_the_gradient_to_the_others(
    clipping, log_weight
):
    """A ratio that single precision rounds to 0, or nearly: as if its advantages were 0."""
    actor = make_actor()
    batch = make_batch(actor, [16], 2)
    batch["action_log_prob"][0] -= log_weight
    loss = make_lagrangian(actor, cost_clipping=clipping)
    found = gradient(loss(batch)["loss_objective"], actor)
    batch["advantage"][0], batch["cost_advantage"][0] = 0.0, 0.0
    torch.testing.assert_close(found, gradient(loss(batch)["loss_objective"], actor))


@pytest.mark.long
def test_compiles_in_one_graph_that_is_never_recompiled():
    from torch._dynamo.testing import CompileCounterWithBackend

    torch._dynamo.reset()
    actor = make_actor()
    batch = make_batch(actor, [64], 2)
    perturb(actor)
    loss = make_lagrangian(actor)
    loss.prepare(batch, limit_state(0.0, 0.0))
    loss(batch)  # torch finds the function of a divergence once, which Dynamo cannot trace
    counter = CompileCounterWithBackend("aot_eager")
    compiled = torch.compile(loss, fullgraph=True, backend=counter)
    for epoch in range(4):
        losses = compiled(batch)
        expected = loss(batch)
        for key in loss.out_keys:
            torch.testing.assert_close(losses[key], expected[key])
        compiled_gradient = gradient(losses["loss_objective"], actor)
        torch.testing.assert_close(compiled_gradient, gradient(expected["loss_objective"], actor))
        state = limit_state(35.0 + epoch, -4.0, unit=[2.0, 0.5 + epoch])
        loss.multiplier.update(state)
        loss.prepare(batch, state)
        loss.clip_epsilon, loss.entropy_coeff = 0.1 / (epoch + 1), 0.02 / (epoch + 1)
        perturb(actor)
        batch = make_batch(actor, [64], 2)
    assert counter.frame_count == 1


def test_moves_across_devices_and_types():
    actor = make_actor()
    batch = make_batch(actor, [16], 2)
    losses = make_lagrangian(actor).double()(batch.double())
    assert losses["loss_objective"].dtype == torch.float64
    losses = make_lagrangian(actor.to("meta")).to("meta")(batch.to("meta"))
    assert all(value.device.type == "meta" for value in losses.values())


def test_reductions():
    actor = make_actor()
    batch = make_batch(actor, [4, 16])
    loss = PPOLoss(actor, **SETTINGS)
    loss.reduction = "none"
    losses = loss(batch)
    samples = losses["loss_objective"]
    assert samples.shape == losses["loss_entropy"].shape == (4, 16)  # so that they can be added
    mean = PPOLoss(actor, **SETTINGS)(batch)["loss_objective"]
    torch.testing.assert_close(samples.mean(), mean)


def test_a_batch_with_the_gradient_of_its_policy_is_refused():
    """As TorchRL's rollouts are outside of no_grad: the gradient of the ratio would be 0."""
    actor = make_actor()
    batch = actor(make_batch(actor, [16]))
    assert batch["action_log_prob"].requires_grad
    with pytest.raises(ValueError, match=r"'action_log_prob' has a gradient.*torch\.no_grad"):
        PPOLoss(actor, **SETTINGS)(batch)
    PPOLoss(actor, **SETTINGS)(batch.detach())


def test_errors_say_what_to_change():
    actor = make_actor()
    batch = make_batch(actor, [16])
    with pytest.raises(TypeError, match="use PPOLoss or TRPOLoss"):
        PPOLagrangianLoss(actor, None, **SETTINGS, cost_clipping="none")
    loss = make_lagrangian(actor)
    with pytest.raises(ValueError, match="one column per cost limit"):
        loss(batch)
    with pytest.raises(ValueError, match="no trailing dimension"):
        loss(batch.clone().set("action_log_prob", batch["action_log_prob"].unsqueeze(-1)))
    with pytest.raises(ValueError, match=r"expected \(16, 1\)"):
        loss(batch.clone().set("advantage", torch.zeros(16)))
    with pytest.raises(KeyError, match="Did you mean 'advantages'"):
        loss(batch.clone().rename_key_("advantage", "advantages"))
