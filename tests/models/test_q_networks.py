"""Ensembles in batched products against single perceptrons; actors and explorers within bounds."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torch.func import functional_call
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import (
    MLP,
    NormalParamExtractor,
    ProbabilisticActor,
    TanhNormal,
    TruncatedNormal,
)

from safe_rl.models import (
    EnsembleMLP,
    ExploringPolicy,
    QEnsemble,
    make_bounded_actor,
    make_squashed_actor,
)
from safe_rl.models.replay_networks import SquashedNormal

LOW, HIGH = torch.tensor([-1.0, -3.0]), torch.tensor([1.0, 5.0])


def observations(*shape):
    return TensorDict(observation=torch.randn(*shape, 5), batch_size=shape)


def test_an_ensemble_is_as_many_perceptrons():
    ensemble = EnsembleMLP(3, [5, 16, 8, 2])
    inputs = torch.randn(4, 7, 5)
    values = ensemble(inputs)
    assert values.shape == (3, 4, 7, 2)
    single = MLP(5, 2, num_cells=[16, 8], activation_class=torch.nn.ReLU)
    for number in range(3):
        weights = {}
        for layer, (weight, bias) in enumerate(zip(ensemble.weights, ensemble.biases, strict=True)):
            weights[f"{2 * layer}.weight"] = weight[number].T
            weights[f"{2 * layer}.bias"] = bias[number, 0]
        torch.testing.assert_close(values[number], functional_call(single, weights, inputs))


def test_its_weights_begin_like_those_of_torch():
    weight = EnsembleMLP(20, [300, 400]).weights[0]
    reference = torch.nn.Linear(300, 400).weight
    assert weight.std().item() == pytest.approx(reference.std().item(), rel=0.02)
    assert weight.abs().max() <= reference.abs().max() * 1.001
    assert not torch.equal(weight[0], weight[1])


def test_q_functions_see_scaled_observations_and_the_action():
    scale = torch.tensor([1.0, 0.1, 1.0, 1.0, 1.0])
    sizes = {"hidden_sizes": [8], "num_networks": 2, "num_outputs": 3}
    q = QEnsemble(5, 2, **sizes, input_scale=scale, in_keys=[("agents", "observation"), "action"])
    steps = TensorDict(agents=observations(4), action=torch.rand(4, 2), batch_size=[4])
    values = q(steps)
    assert values.batch_size == (2, 4)
    expected = q.network(torch.cat([steps["agents", "observation"] * scale, steps["action"]], -1))
    assert torch.equal(values["state_action_value"], expected)
    assert "state_action_value" not in steps.keys()  # noqa: SIM118


def make_of_two_modules(size, low, high, hidden_sizes):
    first = TensorDictModule(nn.Linear(size, size), ["observation"], ["features"])
    last = make_bounded_actor(size, low, high, hidden_sizes=hidden_sizes, in_keys=["features"])
    return TensorDictSequential(first, last)


@pytest.mark.parametrize("make", [make_squashed_actor, make_bounded_actor, make_of_two_modules])
def test_without_noise_an_explorer_acts_like_its_actor(make):
    actor = make(5, LOW, HIGH, hidden_sizes=[8])
    explorer, batch = ExploringPolicy(actor, LOW, HIGH, noise=0.5), observations(64)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        expected, found = actor(batch.clone())["action"], explorer(batch.clone())["action"]
    torch.testing.assert_close(found, expected)
    assert ((found > LOW) & (found < HIGH)).all()


def own_actor(distribution, **settings):
    parameters = TensorDictModule(
        nn.Sequential(nn.Linear(5, 4), NormalParamExtractor()), ["observation"], ["loc", "scale"]
    )
    kind = {"distribution_class": distribution, "distribution_kwargs": settings}
    return ProbabilisticActor(parameters, in_keys=["loc", "scale"], **kind)


@pytest.mark.parametrize(
    "make",
    [
        lambda: make_squashed_actor(5, LOW, HIGH, hidden_sizes=[8]),
        lambda: own_actor(TruncatedNormal, low=LOW, high=HIGH),
        lambda: own_actor(TanhNormal, low=LOW, high=HIGH, tanh_loc=True),
    ],
)
def test_it_samples_the_distribution_of_its_actor(make):
    actor = make()
    batch = observations(1).expand(20_000).clone()
    with torch.no_grad():
        found = ExploringPolicy(actor, LOW, HIGH)(batch.clone())["action"]
        expected = actor.get_dist(batch).sample()
    quantiles = torch.linspace(0.05, 0.95, 7)
    spread = HIGH - LOW
    for column in range(2):
        ours, theirs = (a[:, column].quantile(quantiles) for a in (found, expected))
        torch.testing.assert_close(ours, theirs, atol=0.02 * spread[column].item(), rtol=0)


def test_it_adds_noise_to_a_deterministic_actor_within_bounds():
    network, key = make_bounded_actor(5, LOW, HIGH, hidden_sizes=[8]).module, ("agents", "action")
    actor = TensorDictModule(network, [("agents", "observation")], [key])
    batch = TensorDict(agents=observations(1), batch_size=[1]).expand(20_000).clone()
    with torch.no_grad():
        own = actor(batch.clone())[key][0]
        found = ExploringPolicy(actor, LOW, HIGH, noise=0.1)(batch)[key]
    torch.testing.assert_close(found.std(0), torch.tensor([0.1, 0.4]), rtol=0.05, atol=0)
    torch.testing.assert_close(found.mean(0), own, rtol=0, atol=0.02)
    with torch.no_grad():
        wild = ExploringPolicy(actor, LOW, HIGH, noise=10.0)(batch)[key]
    assert ((wild >= LOW) & (wild <= HIGH)).all()


def test_it_begins_at_random_but_is_never_evaluated_so():
    actor = make_squashed_actor(5, LOW, HIGH, hidden_sizes=[8])
    explorer, batch = ExploringPolicy(actor, LOW, HIGH), observations(20_000)
    explorer.is_random.fill_(True)
    found = explorer(batch)["action"]
    torch.testing.assert_close(found.mean(0), (LOW + HIGH) / 2, atol=0.05, rtol=0)
    torch.testing.assert_close(found.var(0), (HIGH - LOW).square() / 12, rtol=0.05, atol=0)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        torch.testing.assert_close(explorer(batch)["action"], actor(batch)["action"])


def test_a_squashed_normal_is_torchrls():
    """Samples and scores as its, without building it; everything else by building it."""
    loc = torch.randn(6, 2, dtype=torch.double).requires_grad_()
    scale = (torch.rand(6, 2, dtype=torch.double) + 0.3).requires_grad_()
    bounds = {"low": LOW.double(), "high": HIGH.double()}
    ours = SquashedNormal(loc, scale, **bounds)
    torch.manual_seed(0)
    action, log_prob = ours.rsample_and_log_prob()
    assert "base_dist" not in vars(ours)
    stock = TanhNormal(loc, scale, **bounds)
    torch.testing.assert_close(log_prob, stock.log_prob(action))
    torch.manual_seed(0)
    expected = stock.rsample_and_log_prob()
    torch.testing.assert_close((action, log_prob), expected)
    for ours_sum, stock_sum in zip((action, log_prob), expected, strict=True):
        gradients = [
            torch.autograd.grad(each.sum(), (loc, scale), retain_graph=True)
            for each in (ours_sum, stock_sum)
        ]
        torch.testing.assert_close(*gradients)
    assert torch.equal(ours.deterministic_sample, stock.deterministic_sample)
    assert ours.batch_shape == stock.batch_shape
    assert ours.rsample_and_log_prob((3,))[1].shape == (3, 6)
    with pytest.raises(AttributeError, match="has no attribute 'colour'"):
        _ = ours.colour
    # samples at the bounds are scored
    far = SquashedNormal(torch.full((4, 2), 30.0), torch.ones(4, 2), low=LOW, high=HIGH)
    action, log_prob = far.rsample_and_log_prob()
    assert torch.equal(action, HIGH.expand(4, 2))
    assert log_prob.isfinite().all()
