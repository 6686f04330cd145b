"""Networks: initialisation, distribution, scales of inputs, and the fast behaviour policy."""

import math

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import nn
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import IndependentNormal, ProbabilisticActor

from safe_rl import models
from safe_rl.objectives import CriticLoss


def observations(*shape):
    return TensorDict({"observation": torch.randn(*shape, 5)}, list(shape))


def linear_layers(module):
    return [layer for layer in module.modules() if isinstance(layer, nn.Linear)]


def test_weights_are_glorot_uniform_and_biases_zero():
    for layer in linear_layers(models.make_critic(200, hidden_sizes=[300, 100])):
        bound = math.sqrt(6 / (layer.in_features + layer.out_features))
        assert layer.weight.abs().max() <= bound
        # a uniform variable on [-b, b] has the standard deviation b / sqrt(3)
        if layer.weight.numel() > 1000:
            assert layer.weight.std().item() == pytest.approx(bound / math.sqrt(3), rel=0.05)
        assert not layer.bias.any()


def test_actor_is_a_tanh_perceptron_with_a_diagonal_gaussian():
    actor = models.make_actor(5, 2, hidden_sizes=[6, 7], initial_log_std=-0.5)
    batch = observations(3, 4)
    hidden = batch["observation"]
    first, second, last = linear_layers(actor)
    for layer in (first, second):
        hidden = torch.tanh(hidden @ layer.weight.T + layer.bias)
    loc = hidden @ last.weight.T + last.bias
    reference = torch.distributions.Normal(loc, math.exp(-0.5))
    distribution = actor.get_dist(batch)
    action = torch.randn(3, 4, 2)
    torch.testing.assert_close(distribution.mean, loc)
    torch.testing.assert_close(distribution.log_prob(action), reference.log_prob(action).sum(-1))
    torch.testing.assert_close(distribution.entropy(), reference.entropy().sum(-1))


def test_behaviour_policy_writes_what_the_actor_writes_and_samples_its_distribution():
    actor = models.make_actor(5, 2, hidden_sizes=[6], initial_log_std=-0.3)
    batch = observations(20_000)
    with torch.no_grad():
        sample, expected = models.BehaviourPolicy(actor)(batch.clone()), actor(batch)
    assert set(sample.keys()) == set(expected.keys())
    assert all(sample[key].shape == expected[key].shape for key in expected.keys())  # noqa: SIM118
    distribution = actor.get_dist(batch)
    torch.testing.assert_close(sample["loc"], distribution.mean)
    torch.testing.assert_close(sample["action_log_prob"], distribution.log_prob(sample["action"]))
    noise = (sample["action"] - sample["loc"]) / sample["scale"]
    torch.testing.assert_close(noise.mean(0), torch.zeros(2), atol=0.02, rtol=0)
    torch.testing.assert_close(noise.std(0), torch.ones(2), atol=0.02, rtol=0)
    assert torch.corrcoef(noise.T)[0, 1].abs() < 0.03


def test_behaviour_policy_follows_the_actors_parameters_and_the_exploration_type():
    actor = models.make_actor(5, 2, hidden_sizes=[6], initial_log_std=-0.5)
    policy = models.BehaviourPolicy(actor)
    batch = observations(4)
    with torch.no_grad():
        for parameter in actor.parameters():
            parameter.add_(0.1)
    for kind in (ExplorationType.DETERMINISTIC, ExplorationType.MODE, ExplorationType.MEAN):
        with set_exploration_type(kind):
            sample, expected = policy(batch.clone()), actor(batch.clone())
        assert torch.equal(sample["action"], expected["action"])
        assert torch.equal(sample["action"], actor.get_dist(batch).mean)
    with set_exploration_type(ExplorationType.RANDOM):
        assert not torch.equal(policy(batch)["action"], sample["action"])


def test_an_actor_of_somebody_elses_is_left_alone():
    """Its network may put out other things, in another order, for another distribution."""
    layers = nn.Sequential(nn.Linear(5, 4), NormalParamExtractor())
    keys = ["loc", "scale"]
    network = TensorDictModule(layers, in_keys=["observation"], out_keys=keys)
    actor = ProbabilisticActor(network, in_keys=keys, distribution_class=IndependentNormal)
    assert models.make_behaviour(actor) is actor
    actor = models.make_actor(5, 2, hidden_sizes=[6], initial_log_std=-0.5)
    assert isinstance(models.make_behaviour(actor), models.BehaviourPolicy)


def test_input_scale_is_fixed_saved_and_applied():
    scale = models.input_scale_vector(
        {"gyro": 0.5, "absent": 9.0}, {"gyro": slice(3, 5), "lidar": slice(0, 3)}, 5
    )
    assert scale.tolist() == [1.0, 1.0, 1.0, 0.5, 0.5]
    scaled = models.make_critic(5, hidden_sizes=[6], input_scale=scale)
    (first, last), batch = linear_layers(scaled), observations(4)
    expected = last(torch.tanh(first(batch["observation"] * scale)))
    torch.testing.assert_close(scaled(batch)["state_value"], expected)
    assert all(parameter is not scale for parameter in scaled.parameters())
    assert sum("scale" in name for name in scaled.state_dict()) == 1
    assert models.input_scale_vector({"gyro": 0.5}, {"lidar": slice(0, 3)}, 3) is None


def batches(number=4):
    scale, shift = torch.tensor([1.0, 100.0, 0.01]), torch.tensor([0.0, 1e4, 3.0])
    values = torch.randn(number, 5, 20, 3) * scale + shift
    return [TensorDict(observation=x, batch_size=[5, 20]) for x in values]


def test_moments_are_those_of_everything_observed():
    running = models.RunningScale(3, key="observation", clip=10.0)
    seen = batches()
    for batch in seen:
        running.update(batch)
    everything = torch.cat([batch["observation"].reshape(-1, 3) for batch in seen]).double()
    torch.testing.assert_close(running.mean, everything.mean(0))
    normalised = running(everything)
    torch.testing.assert_close(normalised.mean(0), torch.zeros(3).double(), atol=1e-6, rtol=0)
    torch.testing.assert_close(normalised.std(0, correction=0), torch.ones(3).double())


def test_nothing_is_changed_before_anything_is_observed_but_for_the_cut():
    running = models.RunningScale(2, key="observation", clip=5.0)
    assert running(torch.tensor([[3.0, -80.0]])).tolist() == [[3.0, -5.0]]
    # columns that never change keep their unit
    running.update(TensorDict(observation=torch.tensor([[7.0, 1.0], [7.0, 3.0]]), batch_size=[2]))
    assert running(torch.tensor([[7.5, 4.0]])).tolist() == [[0.5, 2.0]]


def test_losses_that_were_made_before_see_them_move():
    """Losses hold the parameters of their networks in containers of their own."""
    critic = models.make_critic(3, hidden_sizes=[4])
    critic.module.insert(0, models.RunningScale(3, key="observation", clip=10.0))
    loss, (batch, other) = CriticLoss(critic), batches(2)
    batch["value_target"] = torch.zeros(5, 20, 1)
    models.update_running_scales([critic], other)
    with torch.no_grad():
        expected = nn.functional.mse_loss(critic(batch)["state_value"], batch["value_target"])
        assert loss(batch)["loss_critic"].item() == pytest.approx(expected.item())
