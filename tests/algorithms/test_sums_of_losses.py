"""The sum that updates minimise, and what they say when it is no number."""

import torch
from tensordict import TensorDict

from safe_rl.algorithms.losses import divergence, sum_of_losses

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


def test_a_sum_beyond_all_numbers_is_said_to_be_one():
    huge = torch.tensor(3e38)
    losses = TensorDict(loss_actor=huge, loss_qvalue=huge.clone())
    assert sum_of_losses(losses).isinf()
    assert str(divergence(losses)).startswith("The sum of the losses is not finite: training")
