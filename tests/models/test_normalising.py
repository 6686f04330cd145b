"""Running moments of observations, against torch's of all that was observed."""

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from safe_rl.models import RunningScale, make_critic, take_in
from safe_rl.objectives import CriticLoss


def batches(number=4):
    scale, shift = torch.tensor([1.0, 100.0, 0.01]), torch.tensor([0.0, 1e4, 3.0])
    values = torch.randn(number, 5, 20, 3) * scale + shift
    return [TensorDict(observation=x, batch_size=[5, 20]) for x in values]


def test_moments_are_those_of_everything_observed():
    running = RunningScale(3, key="observation", clip=10.0)
    seen = batches()
    for batch in seen:
        running.update(batch)
    everything = torch.cat([batch["observation"].reshape(-1, 3) for batch in seen]).double()
    torch.testing.assert_close(running.mean, everything.mean(0))
    normalised = running(everything)
    torch.testing.assert_close(normalised.mean(0), torch.zeros(3).double(), atol=1e-6, rtol=0)
    torch.testing.assert_close(normalised.std(0, correction=0), torch.ones(3).double())


def test_nothing_is_changed_before_anything_is_observed_but_for_the_cut():
    running = RunningScale(2, key="observation", clip=5.0)
    assert running(torch.tensor([[3.0, -80.0]])).tolist() == [[3.0, -5.0]]


def test_columns_that_never_change_keep_their_unit():
    running = RunningScale(2, key="observation", clip=5.0)
    running.update(TensorDict(observation=torch.tensor([[7.0, 1.0], [7.0, 3.0]]), batch_size=[2]))
    assert running(torch.tensor([[7.5, 4.0]])).tolist() == [[0.5, 2.0]]


def test_a_checkpoint_holds_them():
    first, second = (RunningScale(3, key="observation", clip=10.0) for _ in range(2))
    before, after = batches(2)
    first.update(before)
    second.load_state_dict(first.state_dict())
    for running in (first, second):
        running.update(after)
    assert all((x == y).all() for x, y in zip(first.buffers(), second.buffers(), strict=True))


def test_losses_that_were_made_before_see_them_move():
    """Losses hold the parameters of their networks in containers of their own."""
    critic = make_critic(3, hidden_sizes=[4])
    critic.module.insert(0, RunningScale(3, key="observation", clip=10.0))
    loss, (batch, other) = CriticLoss(critic), batches(2)
    batch["value_target"] = torch.zeros(5, 20, 1)
    take_in([critic], other)
    with torch.no_grad():
        expected = nn.functional.mse_loss(critic(batch)["state_value"], batch["value_target"])
        assert loss(batch)["loss_critic"].item() == pytest.approx(expected.item())
