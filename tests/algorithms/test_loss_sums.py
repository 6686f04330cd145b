"""The sum that updates minimise, and what they say when it is no number."""

import pytest
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
