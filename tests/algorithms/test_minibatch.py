"""Minibatch updates against plain loops and closed forms, and the sum that updates minimise."""

import functools

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.objectives import A2CLoss, ClipPPOLoss

from safe_rl.algorithms.losses import divergence, sum_of_losses
from safe_rl.algorithms.minibatch import KLAdaptiveRate, MinibatchUpdate
from safe_rl.models import BehaviourPolicy, make_actor, make_critic
from safe_rl.objectives import PPOLoss

adam = functools.partial(torch.optim.Adam, lr=1e-2)


class RecordingLoss(nn.Module):
    """Loss (w - x)² that remembers the samples it saw; its KL grows with every call."""

    in_keys = ["x"]  # noqa: RUF012

    def __init__(self):
        super().__init__()
        self.w = nn.Parameter(torch.zeros(()))
        self.seen = []

    def forward(self, batch):
        self.seen.append(batch["x"].clone())
        kl = torch.tensor(0.004 * (len(self.seen) - 1))
        return TensorDict(loss_objective=(self.w - batch["x"]).square().mean(), kl=kl)


def samples(*shape):
    count = torch.Size(shape).numel()
    return TensorDict({"x": torch.arange(float(count)).reshape(shape)}, list(shape))


@pytest.mark.parametrize(("minibatch_size", "expected"), [(5, 4), (7, 3), (20, 1), (50, 1)])
def test_a_pass_takes_equal_parts_of_the_batch_without_repetition(minibatch_size, expected):
    loss = RecordingLoss()
    update = MinibatchUpdate(loss, optimizer=adam, num_passes=3, minibatch_size=minibatch_size)
    diagnostics = update(samples(4, 5))
    assert diagnostics["num_steps"] == 3 * expected == len(loss.seen)
    assert len({len(part) for part in loss.seen}) == 1
    for start in range(0, len(loss.seen), expected):
        taken = torch.cat(loss.seen[start : start + expected])
        assert len(taken.unique()) == len(taken) > 20 - expected
    if expected > 1:
        assert not torch.equal(loss.seen[0], loss.seen[expected])


def test_the_whole_batch_as_minibatch_is_plain_gradient_descent():
    loss, reference = RecordingLoss(), RecordingLoss()
    MinibatchUpdate(loss, optimizer=adam, num_passes=7, minibatch_size=None)(samples(4, 5))
    optimizer = adam(reference.parameters())
    for _ in range(7):
        optimizer.zero_grad()
        reference(samples(20))["loss_objective"].backward()
        optimizer.step()
    assert torch.equal(loss.w, reference.w)


@pytest.mark.parametrize("beyond", [False, True])
def test_the_update_stops_before_or_after_the_first_step_beyond_the_kl_limit(beyond):
    loss, reference = RecordingLoss(), RecordingLoss()
    common = {"optimizer": adam, "minibatch_size": None}
    update = MinibatchUpdate(loss, num_passes=80, max_kl=0.012, step_beyond_kl=beyond, **common)
    diagnostics = update(samples(20))
    # the KLs are 0, .004, .008, .012, .016: the fifth exceeds the limit, after four steps
    MinibatchUpdate(reference, num_passes=4 + beyond, **common)(samples(20))
    assert diagnostics["num_steps"] == 4 + beyond
    assert diagnostics["kl"].item() == pytest.approx(0.016)
    assert torch.equal(loss.w, reference.w)


def ppo_batch(actor):
    batch = TensorDict({"observation": torch.randn(8, 16, 5)}, [8, 16])
    with torch.no_grad():
        batch = BehaviourPolicy(actor)(batch)
    return batch.set("advantage", batch["action"][..., :1] - batch["loc"][..., :1])


@pytest.mark.parametrize(("kind", "settings"), [(A2CLoss, {}), (ClipPPOLoss, {"clip_value": 0.1})])
def test_losses_of_torchrls_get_the_advantages_of_the_batch(kind, settings):
    """Theirs would be of shuffled samples, as if one followed the other."""
    actor = make_actor(5, 2, hidden_sizes=[16], initial_log_std=-0.5)
    critic = make_critic(5, hidden_sizes=[16])
    batch = ppo_batch(actor)
    value, flags = torch.randn(8, 16, 1), torch.zeros(8, 16, 1, dtype=torch.bool)
    batch["state_value"], batch["value_target"] = value, value + batch["advantage"]
    following = {"reward": value, "done": flags, "terminated": flags}
    batch["next"] = {**following, "observation": torch.randn(8, 16, 5)}
    loss = kind(actor, critic, **settings)
    expected = loss(batch.reshape(-1).clone())
    still = functools.partial(torch.optim.SGD, lr=0.0)
    found = MinibatchUpdate(loss, optimizer=still, num_passes=2, minibatch_size=32)(batch)
    for name in ("loss_objective", "loss_critic"):
        torch.testing.assert_close(found[name], expected[name].detach())


@pytest.mark.long
def test_compiled_and_plain_updates_agree():
    results = []
    for compile in (False, True):
        torch.manual_seed(1)
        actor = make_actor(5, 2, hidden_sizes=[16], initial_log_std=-0.5)
        batch = ppo_batch(actor)
        loss = PPOLoss(actor, clip_epsilon=0.2, entropy_coeff=0.0)
        update = MinibatchUpdate(
            loss, optimizer=adam, num_passes=3, minibatch_size=32, compile=compile
        )
        results.append((update(batch), actor.get_dist(batch).mean))
    torch.testing.assert_close(*(mean for _, mean in results), atol=1e-4, rtol=1e-3)
    torch.testing.assert_close(*(diagnostics for diagnostics, _ in results), atol=1e-4, rtol=1e-2)


# d/dw mean((w - x)²) at w = 0 is -2 mean(x) = -19
@pytest.mark.parametrize(("max_grad_norm", "distance"), [(None, 19.0), (0.5, 0.5)])
def test_gradients_are_clipped(max_grad_norm, distance):
    loss, sgd = RecordingLoss(), functools.partial(torch.optim.SGD, lr=1.0)
    settings = {"num_passes": 1, "minibatch_size": None, "max_grad_norm": max_grad_norm}
    MinibatchUpdate(loss, optimizer=sgd, **settings)(samples(20))
    assert loss.w.item() == pytest.approx(distance, abs=1e-5)


def test_a_batch_beyond_the_limit_before_the_first_step_is_reported():
    """Stored data of another policy: the step is refused, the rate has nothing to learn from it."""
    actor = make_actor(5, 2, hidden_sizes=[16], initial_log_std=-0.5)
    batch = ppo_batch(actor)
    before = [parameter.detach().add_(0.3).clone() for parameter in actor.parameters()]
    adapt = KLAdaptiveRate(factor=2.0, lowest=1e-5, highest=1.0, few_steps=0.7, low_kl=0.7)
    loss = PPOLoss(actor, clip_epsilon=0.2, entropy_coeff=0.0)
    update = MinibatchUpdate(
        loss, optimizer=adam, num_passes=3, minibatch_size=32, max_kl=0.01, adapt_rate=adapt
    )
    with pytest.warns(UserWarning, match=r"beyond max_kl=0\.01"):
        diagnostics = update(batch)
    assert diagnostics["num_steps"] == 0
    assert diagnostics["kl"] > 0.01
    assert diagnostics["lr"].item() == pytest.approx(1e-2)
    assert all(map(torch.equal, actor.parameters(), before))


class Falling(RecordingLoss):
    def forward(self, batch):
        return super().forward(batch).set("cost_surrogate", torch.tensor(1.0 - len(self.seen)))


class Overflowing(RecordingLoss):
    def forward(self, batch):
        losses = super().forward(batch)
        if len(self.seen) > 2:
            losses["loss_objective"] = losses["loss_objective"] * torch.inf
        return losses


def test_predicted_costs_are_those_after_the_passes():
    """Their mean over the steps is about half of the change that an update predicts."""
    update = MinibatchUpdate(Falling(), optimizer=adam, num_passes=4, minibatch_size=None)
    assert update(samples(20))["cost_surrogate"] == -3.0


def test_the_step_after_a_loss_that_is_no_number_is_not_taken():
    loss, reference = Overflowing(), RecordingLoss()
    update = MinibatchUpdate(loss, optimizer=adam, num_passes=9, minibatch_size=None)
    with pytest.raises(FloatingPointError, match="'loss_objective' is inf"):
        update(samples(20))
    MinibatchUpdate(reference, optimizer=adam, num_passes=2, minibatch_size=None)(samples(20))
    assert torch.equal(loss.w, reference.w)
    with pytest.raises(FloatingPointError, match="'x' is not finite in 1 of 1"):
        update(TensorDict({"x": torch.tensor([float("nan")])}, [1]))


def test_the_rate_follows_the_kl_divergence():
    adapt = KLAdaptiveRate(factor=2.0, lowest=1e-4, highest=4e-3, few_steps=0.5, low_kl=0.5)
    assert adapt(1e-3, share_of_steps=0.4, share_of_kl=2.0) == pytest.approx(5e-4)
    assert adapt(1e-3, share_of_steps=1.0, share_of_kl=0.4) == pytest.approx(2e-3)
    assert adapt(1e-3, share_of_steps=1.0, share_of_kl=0.9) == pytest.approx(1e-3)
    assert adapt(1e-3, share_of_steps=0.8, share_of_kl=1.1) == pytest.approx(1e-3)
    assert adapt(1e-4, share_of_steps=0.0, share_of_kl=9.0) == pytest.approx(1e-4)
    assert adapt(4e-3, share_of_steps=1.0, share_of_kl=0.0) == pytest.approx(4e-3)


def test_an_update_that_ends_early_lowers_the_next_rate():
    adapt = KLAdaptiveRate(factor=2.0, lowest=1e-5, highest=1.0, few_steps=0.7, low_kl=0.7)
    common = {"optimizer": adam, "minibatch_size": 5, "num_passes": 3, "adapt_rate": adapt}
    # The recording loss reports a KL of 0, 0.004, 0.008, …: 12 steps are planned.
    ended = MinibatchUpdate(RecordingLoss(), max_kl=0.01, **common)
    assert ended(samples(4, 5))["num_steps"] == 3
    assert ended.optimizer.param_groups[0]["lr"] == pytest.approx(5e-3)
    short = MinibatchUpdate(RecordingLoss(), max_kl=1.0, **common)
    assert short(samples(4, 5))["lr"] == pytest.approx(2e-2)
    nearly = MinibatchUpdate(RecordingLoss(), max_kl=0.05, **common)  # of which the last is 0.88
    assert nearly(samples(4, 5))["lr"] == pytest.approx(1e-2)
    with pytest.raises(ValueError, match="max_kl"):
        MinibatchUpdate(RecordingLoss(), **common)


LOSSES = TensorDict(
    loss_qvalue=torch.tensor(torch.inf),
    loss_actor=torch.tensor(2.0),
    cost_weight=torch.tensor([torch.nan, 1.0]),  # of two costs
)


def test_what_is_no_loss_is_neither_summed_nor_blamed():
    assert sum_of_losses(LOSSES.clone().set("loss_qvalue", torch.tensor(0.5))) == 2.5
    said = str(divergence(LOSSES))
    assert said.startswith("'loss_qvalue' is inf: training has diverged.")
    assert "cost_weight" not in said


@pytest.mark.parametrize("shape", [(40, 1), (40,)])
def test_a_loss_of_every_sample_is_named(shape):
    """Alone it would be summed instead of averaged, beside others it cannot be stacked."""
    losses = TensorDict(loss_more=torch.ones(shape))
    for given in (losses, losses.clone().set("loss_objective", torch.tensor(1.0))):
        with pytest.raises(ValueError, match=r"'loss_more' has shape \[40.*mean"):
            sum_of_losses(given)
    assert sum_of_losses(TensorDict(loss_a=torch.ones(1), loss_b=torch.tensor(2.0))) == 3


def test_what_is_no_mapping_of_losses_is_told():
    with pytest.raises(ValueError, match=r"a TensorDict with entries named 'loss_…', got .*Tensor"):
        sum_of_losses(torch.tensor(1.0))
    with pytest.raises(ValueError, match=r"an entry named 'loss_…'.*It returned \['objective'\]"):
        sum_of_losses(TensorDict(objective=torch.tensor(1.0)))


def test_a_sum_beyond_all_numbers_is_said_to_be_one():
    huge = torch.tensor(3e38)
    losses = TensorDict(loss_actor=huge, loss_qvalue=huge.clone())
    assert sum_of_losses(losses).isinf()
    assert str(divergence(losses)).startswith("The sum of the losses is not finite: training")
