"""A problem of one state and a few actions, in which expectations are known without sampling."""

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torch.distributions import Categorical
from torchrl.modules import ProbabilisticActor


def total(losses):
    return sum(value for key, value in losses.items() if key.startswith("loss_"))


class Logits(nn.Module):
    """The same logits in every state."""

    def __init__(self, count):
        super().__init__()
        self.logits = nn.Parameter(torch.zeros(count))

    def forward(self, observation):
        return self.logits.expand(*observation.shape[:-1], -1)


def one_state(advantage, *cost_advantages):
    """A policy of a few actions, uniform at first, and a batch with every action once.

    Means over the batch are expectations under the first policy, without a sampling error.
    """
    count = len(advantage)
    actor = ProbabilisticActor(
        TensorDictModule(Logits(count), ["observation"], ["logits"]),
        in_keys=["logits"],
        distribution_class=Categorical,
        return_log_prob=True,
    )
    uniform = torch.full((count,), 1 / count).log()
    batch = TensorDict(
        observation=torch.zeros(count, 1),
        action=torch.arange(count),
        action_log_prob=uniform,
        logits=uniform.expand(count, count),
        advantage=torch.tensor(advantage).unsqueeze(-1),
        cost_advantage=torch.tensor(cost_advantages).T,
        batch_size=[count],
    )
    return actor, next(actor.parameters()), batch


def minimise(loss, logits, batch):
    """Find the policy of which a loss is lowest."""
    optimizer = torch.optim.LBFGS([logits], max_iter=200, line_search_fn="strong_wolfe")

    def closure():
        optimizer.zero_grad()
        value = total(loss(batch))
        value.backward()
        return value

    optimizer.step(closure)
