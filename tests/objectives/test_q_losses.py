"""Losses on Q functions against TorchRL's own, against formulas written out, and finite limits."""

import copy

import pytest
import torch
from q_losses import BOUNDS, COSTS, SAC, SPEC, TD3, lagrange, make_loss, make_q, make_steps, told
from samples import limit_state
from torch import nn
from torchrl import objectives
from torchrl.data import Bounded
from torchrl.modules import MLP, ValueOperator
from torchrl.objectives import ValueEstimators
from torchrl.objectives.value import TD0Estimator

from safe_rl.models import make_bounded_actor, make_squashed_actor
from safe_rl.objectives import LagrangeMultiplier, SACLagrangianLoss, SACLoss, TD3Loss


def as_stock(loss, kind):
    """TorchRL's own loss, with vmap, on the same weights."""
    actor = loss.actor_network
    module = nn.Module()
    module.mlp = MLP(5, 1, num_cells=[8], activation_class=nn.ReLU)
    module.forward = lambda observation, action: module.mlp(torch.cat([observation, action], -1))
    critics = ValueOperator(module, in_keys=["observation", "action"])
    shared = {"loss_function": "l2", "action_spec": SPEC}
    if kind == "sac":
        stock = objectives.SACLoss(actor, critics, alpha_init=0.2, **shared)
    else:
        stock = objectives.TD3Loss(actor, critics, policy_noise=0.2, noise_clip=0.5, **shared)
    stock.make_value_estimator(ValueEstimators.TD0, gamma=0.9)
    for ours, theirs in (
        (loss.qvalue_network_params, stock.qvalue_network_params),
        (loss.target_qvalue_network_params, stock.target_qvalue_network_params),
    ):
        for layer in range(2):
            place = ("module", "mlp", str(2 * layer))
            weight = ours["network", "weights", str(layer)].data.transpose(1, 2)
            theirs[(*place, "weight")].data.copy_(weight)
            theirs[(*place, "bias")].data.copy_(ours["network", "biases", str(layer)].data[:, 0])
    return stock


def drawn(function, steps, *arguments):
    """What a function of steps gives, always with the same draws."""
    torch.manual_seed(1)
    return function(steps.clone(), *arguments)


def value_loss(stock, kind, steps):
    """TorchRL's loss of the Q functions, and what it reports."""
    return drawn(stock.value_loss if kind == "td3" else stock.qvalue_v2_loss, steps)


@pytest.mark.parametrize("spans", [None, (6,), (6, 1)])
@pytest.mark.parametrize("kind", ["sac", "td3"])
def test_an_ensemble_gives_what_torchrl_gives(kind, spans):
    """Also of several steps at a time; their number may have a dimension of its own."""
    loss, steps = make_loss(kind), make_steps()
    if spans is not None:
        steps["steps_to_next_obs"] = torch.tensor([1, 2, 3, 1, 2, 3]).reshape(spans)
    stock = as_stock(loss, kind)
    expected, reported = value_loss(stock, kind, steps)
    torch.manual_seed(1)
    found = loss.critic_losses(given := steps.clone())
    torch.testing.assert_close(found["loss_qvalue"], expected)
    priority = reported["td_error"]
    if kind == "td3":  # of both networks, and squared
        priority = priority.max(0).values.sqrt()
    torch.testing.assert_close(given["td_error"], priority)
    losses = drawn(loss.actor_losses, steps)["loss_actor"], drawn(stock.actor_loss, steps)[0]
    torch.testing.assert_close(*losses)
    gradients = []
    for module, value in zip((loss, stock), losses, strict=True):
        parameters = module.actor_network_params.values(True, True)
        trained = [p for p in parameters if p.requires_grad]
        gradients.append(torch.autograd.grad(value, trained))
    torch.testing.assert_close(*gradients)


def test_scripts_of_torchrls_td3_find_the_two_losses():
    loss, steps = make_loss("td3"), make_steps()
    stock = as_stock(loss, "td3")
    for name in ("value_loss", "actor_loss"):
        found = [drawn(getattr(module, name), steps)[0] for module in (loss, stock)]
        torch.testing.assert_close(*found)


@pytest.mark.parametrize("kind", ["sac", "td3"])
def test_parameters_that_get_other_memory_are_those_of_all_losses(kind):
    """As `p.data = …` and `vector_to_parameters` do."""
    loss, steps = make_loss(kind, lagrange(2.0, 3.0)), make_steps()
    told(loss, [1.0, 0.5], rewards=[-0.25, 0.25])
    loss.actor_losses(steps)
    for network in (loss.qvalue_network, loss.cost_qvalue_network):
        vector = nn.utils.parameters_to_vector(network.parameters())
        nn.utils.vector_to_parameters(3.0 * vector, network.parameters())
    # a copy has nothing that was kept
    losses = [drawn(each.actor_losses, steps) for each in (loss, copy.deepcopy(loss))]
    torch.testing.assert_close(*(each["loss_actor"] for each in losses))


@pytest.mark.parametrize("kind", ["sac", "td3"])
def test_costs_are_weighed_by_their_multipliers_in_units_of_one_cost(kind):
    loss, steps = make_loss(kind, lagrange(2.0, 3.0), pessimism=0.5), make_steps()
    told(loss, [1.0, 0.5], rewards=[-0.25, 0.25])
    found = drawn(loss.actor_losses, steps)
    reward = drawn(as_stock(loss, kind).actor_loss, steps)[0]
    torch.manual_seed(1)
    if kind == "sac":
        action = loss.actor_network.get_dist(steps).rsample()
    else:
        action = loss.actor_network(steps.clone())["action"]
    values = loss.cost_qvalue_network(steps.clone().set("action", action))["cost_value"]
    spread = (values - values.mean(0)).square().mean(0).sqrt()
    penalty = ((values.mean(0) + 0.5 * spread) * torch.tensor([2.0, 6.0])).sum(-1).mean()
    torch.testing.assert_close(found["loss_actor"], (reward + 0.25 * penalty) / 6)
    torch.testing.assert_close(found["cost_qvalue"], values.mean((0, 1)))


def test_the_size_of_rewards_is_the_deviation_of_all_so_far():
    loss, rewards = make_loss("sac", lagrange(1.0, 1.0)), 1000 + 7 * torch.randn(300, 1)
    for batch in rewards.split([50, 150, 100]):
        told(loss, [1.0, 1.0], rewards=batch)
    assert loss.reward_unit.item() == pytest.approx(rewards.numpy().std(), rel=1e-5)
    equal = torch.full((275, 1), 0.1)  # so many that their sums are not exact
    assert told(make_loss("sac", lagrange(1.0, 1.0)), [1.0, 1.0], rewards=equal).reward_unit == 1


@pytest.mark.parametrize("kind", ["sac", "td3"])
@pytest.mark.parametrize("key", [None, "steps_to_next_obs", "span"])
@pytest.mark.parametrize("is_bounded", [False, True])
def test_costs_are_learned_by_the_errors_of_their_targets(kind, key, is_bounded):
    """Of the steps that a transition spans, and of the larger of two networks within bounds."""
    bounds = {"target_pessimism": 1.0, "lowest_cost_value": 0.1} if is_bounded else {}
    loss, steps = make_loss(kind, lagrange(1.0, 1.0), **bounds), make_steps()
    discount = torch.full((6, 1), 0.9)
    if key is not None:
        loss.value_estimator.set_keys(steps_to_next_obs=key)
        spans = torch.tensor([1, 2, 3, 1, 2, 3])
        steps[key], discount = spans.reshape((6, 1) if key == "span" else 6), 0.9 ** spans[:, None]
    action, network = torch.rand(6, 2), loss.cost_qvalue_network
    found = loss.cost_qvalue_loss(steps, action)
    following = network(steps["next"].clone().set("action", action))["cost_value"]
    if is_bounded:
        following = torch.maximum(following[0], following[1])
        assert 0 < (following > 0.1).sum() < following.numel()
        following = following.clamp(min=0.1)
    costs = torch.cat([steps["next", name] for name in COSTS], -1)
    error = network(steps)["cost_value"] - (costs + discount * following)
    torch.testing.assert_close(found, error.square().sum((0, 2)).mean())


@pytest.mark.parametrize("clip", [0.5, 3.0])
def test_td3_learns_costs_for_actions_with_noise_that_is_cut_within_their_bounds(clip, monkeypatch):
    loss, steps, given = make_loss("td3", lagrange(1.0, 1.0)), make_steps(), []
    loss.policy_noise, loss.noise_clip = 1e9, clip
    monkeypatch.setattr(
        loss, "cost_qvalue_loss", lambda _, action: given.append(action) or torch.zeros(())
    )
    loss.critic_losses(steps)
    without = loss.actor_network(steps["next"].clone())["action"].detach()
    sides = torch.stack([(without + change).clamp(-1, 1) for change in (-clip, clip)])
    assert (given[0] == sides).any(0).all()
    assert (without.abs() < 0.5).all()  # so that one of the two is cut by the bounds


@pytest.mark.parametrize("kind", ["sac", "td3"])
def test_nothing_follows_an_end_but_something_a_time_out(kind):
    """Moving the target networks moves the losses of all steps but terminated ones."""
    for terminated in (True, False):
        loss, steps = make_loss(kind, lagrange(1.0, 1.0)), make_steps(terminated=terminated)
        steps["next", "done"] = torch.ones(6, 1, dtype=torch.bool)
        losses = []
        for _ in range(2):
            losses.append(drawn(loss.critic_losses, steps))
            for target, _ in loss.target_pairs():
                target.data.add_(0.3)
        for name in ("loss_qvalue", "loss_cost_qvalue"):
            assert torch.equal(losses[0][name], losses[1][name]) is terminated


def test_a_critic_that_is_no_ensemble_and_multipliers_of_other_costs_are_refused():
    critic = ValueOperator(nn.Linear(3, 1), in_keys=["observation"])
    networks = make_squashed_actor(3, *BOUNDS, hidden_sizes=[8]), make_q()
    multiplier = lagrange(1.0, 1.0)
    with pytest.raises(ValueError, match=r"cost critic has to be a safe_rl.*, unlike ValueOp"):
        SACLagrangianLoss(*networks, critic, multiplier=multiplier, cost_keys=COSTS, **SAC)
    with pytest.raises(ValueError, match="2 multipliers for the costs"):
        SACLagrangianLoss(*networks, make_q(), multiplier=multiplier, cost_keys=["cost"], **SAC)
    with pytest.raises(ValueError, match="another order"):
        SACLagrangianLoss(*networks, make_q(), multiplier=multiplier, cost_keys=COSTS[::-1], **SAC)
    batched = SPEC.expand(50, *SPEC.shape)
    with pytest.raises(ValueError, match=r"\[50, 2\], and must be .*action_spec_unbatched"):
        SACLoss(*networks, action_spec=batched, gamma=0.9, alpha_init=0.1)
    for make in (make_squashed_actor, make_bounded_actor):
        with pytest.raises(ValueError, match=r"\[50, 2\], and must be .*action_spec_unbatched"):
            make(3, batched.low, batched.high, hidden_sizes=[8])
    with pytest.raises(ValueError, match="One limit for each of"):
        told(make_loss("sac", multiplier, is_prepared=False), [1.0], rewards=[1.0])


def test_the_names_of_nested_entries_are_as_a_batch_has_them():
    keys = [("info", "cost"), "cost_other"]
    multiplier = LagrangeMultiplier(dict.fromkeys(keys, 1.0), init=1.0, lr=0.1)
    networks = make_squashed_actor(3, *BOUNDS, hidden_sizes=[8]), make_q()
    cost_q = make_q(2, num_outputs=2, out_key="cost_value")
    loss = SACLagrangianLoss(*networks, cost_q, multiplier=multiplier, cost_keys=keys, **SAC)
    loss.set_keys(reward=("info", "reward"))
    assert {("next", "info", "cost"), ("next", "info", "reward")} <= {*loss.in_keys}


def test_a_minibatch_that_fails_leaves_the_policy_its_parameters():
    """Or an optimiser would move others than those that collect."""
    loss, steps = make_loss("td3", lagrange(1.0, 1.0)), make_steps()
    before = [*loss.actor_network.parameters()]
    assert before
    with pytest.raises(KeyError):
        loss(steps.exclude(("next", "observation")))
    assert [*map(id, loss.actor_network.parameters())] == [*map(id, before)]


def test_the_smoothing_of_td3_is_of_the_range_of_actions():
    low, high = torch.tensor([-0.4, -2.0]), torch.tensor([0.4, 2.0])
    actor = make_bounded_actor(3, low, high, hidden_sizes=[8])
    settings = TD3 | {"action_spec": Bounded(low, high), "policy_noise": 1.0}
    loss = TD3Loss(actor, make_q(), **settings)
    steps = make_steps()
    found = drawn(loss.smoothed_action, steps)
    torch.manual_seed(1)
    noise = torch.randn(6, 2).clamp(-0.5, 0.5) * high
    torch.testing.assert_close(found, (actor(steps)["action"] + noise).clamp(low, high))
    # what a resumed run is given is not replaced by what it was before
    assert not [name for name in loss.state_dict() if "noise" in name]


@pytest.mark.parametrize("kind", ["sac", "td3"])
@pytest.mark.parametrize("given", ["number", "estimator", "averaged"])
def test_the_value_estimator_that_one_asks_for_is_used(kind, given):
    loss, steps = make_loss(kind, lagrange(1.0, 1.0)), make_steps()
    stock = as_stock(loss, kind)
    for module in (stock, loss):
        if given == "estimator":
            estimator = TD0Estimator(gamma=0.25, value_network=None)
            estimator.set_keys(value=module.value_estimator.tensor_keys.value)
            module.make_value_estimator(estimator)
        else:
            average = {"average_rewards": True} if given == "averaged" else {}
            module.make_value_estimator(ValueEstimators.TD0, gamma=0.25, **average)
    losses = drawn(loss.critic_losses, steps)
    torch.testing.assert_close(losses["loss_qvalue"], value_loss(stock, kind, steps)[0])
    expected = make_loss(kind, lagrange(1.0, 1.0))
    expected.load_state_dict(loss.state_dict())
    expected.gamma = 0.25
    costs = drawn(expected.critic_losses, steps)["loss_cost_qvalue"]
    torch.testing.assert_close(losses["loss_cost_qvalue"], costs)


@pytest.mark.parametrize("kind", ["td3", "sac"])
@pytest.mark.parametrize("multiplier", [None, (1.0, 1.0)])
def test_losses_may_be_asked_for_one_entry(kind, multiplier):
    loss = make_loss(kind, multiplier and lagrange(*multiplier))
    loss.select_out_keys("loss_actor")
    assert list(loss(make_steps()).keys()) == ["loss_actor"]
    loss.reset_out_keys()
    assert "loss_qvalue" in loss(make_steps()).keys()  # noqa: SIM118


@pytest.mark.parametrize("kind", ["sac", "td3"])
@pytest.mark.parametrize("key", ["reward", "terminated", "cost"])
def test_an_entry_of_another_shape_is_named_with_the_shape_that_it_must_have(kind, key):
    steps = make_steps(6)
    steps["next", key] = steps["next", key].squeeze(-1)
    with pytest.raises(ValueError, match=rf"'{key}'\) has the shape \[6\], and must have \[6, 1\]"):
        make_loss(kind, lagrange(1.0, 1.0))(steps)


@pytest.mark.parametrize("kind", ["sac", "td3", "cal"])
def test_steps_get_their_priority_alone_and_what_stands_in_the_padding_does_not_matter(kind):
    loss, steps, found = make_loss(kind, lagrange(1.0, 1.0)), make_steps(), []
    steps["collector", "mask"] = torch.arange(6) < 4
    for value in (0.0, 9.0):
        steps["observation"][4:] = value
        steps["next", "reward"][4:] = value
        loss.reward_sums.zero_()
        loss.prepare(steps, limit_state(0.0, 0.0, unit=[1.0, 1.0]))
        loss.register_buffer("discounted_limit", torch.zeros(2))  # of CAL
        torch.manual_seed(1)
        found.append(loss(given := steps.clone()).to_dict())
    torch.testing.assert_close(*found)
    assert set(given.keys(True, True)) - set(steps.keys(True, True)) == {"td_error"}


@pytest.mark.parametrize("kind", ["sac", "td3"])
def test_the_bias_of_critics_of_costs_that_never_end(kind):
    loss, steps = make_loss(kind, lagrange(1.0, 1.0)), make_steps(100)
    params = loss.cost_qvalue_network_params["network"]
    params["weights", "1"].data.zero_()
    params["biases", "1"].data.copy_(torch.tensor([[[4.0, 1.0]], [[8.0, 3.0]]]))
    for key in COSTS:
        steps["next", key] = torch.full((100, 1), 0.5)
    # half a cost per step is worth 5 at a discount of 0.9; the critics say 6 and 2
    found = loss.cost_bias(steps.reshape(2, 50))
    torch.testing.assert_close(found, torch.tensor([1.0, -3.0]))


def test_steps_without_a_batch_dimension():
    for kind in ("sac", "td3", "cal"):
        loss = make_loss(kind, lagrange(1.0, 1.0))
        assert loss(make_steps()[0])["loss_actor"].isfinite()
