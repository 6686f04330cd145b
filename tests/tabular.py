"""Constrained problems of choices whose optimal policies are known in closed form.

Episodes of `STEPS` steps with one state. Every component of an action has its own reward and cost,
both of which add up. The best feasible policy is a linear programme of the knapsack's kind: take
what earns most per cost, and the last of it with the probability that is left.
"""

from dataclasses import dataclass

import torch
from cmdp import play
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import Categorical, MultiCategorical, TensorSpec

from safe_rl.models.heads import make_head
from safe_rl.models.networks import assemble_actor, perceptron


@dataclass(frozen=True)
class Knapsack:
    spec: TensorSpec
    rewards: tuple[Tensor, ...]  # of every component's choices, [C] each
    costs: tuple[Tensor, ...]
    limits: Tensor  # undiscounted cost per episode, [1]
    optimum: tuple[Tensor, ...]  # probabilities, [C] each

    @property
    def cost_limits(self):
        return {"cost": float(self.limits)}

    def make_actor(self):
        head = make_head("auto", self.spec, initial_log_std=0.0)
        actor = assemble_actor(perceptron(1, head.num_outputs, [], None, None), head)
        for parameter in actor.parameters():
            torch.nn.init.zeros_(parameter)
        return actor

    def probabilities(self, actor):
        """Of every component's choices, one after the other."""
        with torch.no_grad():
            policy = actor.get_dist(TensorDict(observation=torch.ones(1, 1), batch_size=[1]))
        found = getattr(policy, "base_dist", policy).probs[0]
        found = found.view(len(self.costs), -1)
        return torch.cat([p[: len(c)] for p, c in zip(found, self.costs, strict=True)])

    def _sum(self, table, action):
        columns = action.view(*action.shape[:2], -1).unbind(-1)
        return sum(row[column] for row, column in zip(table, columns, strict=True)).unsqueeze(-1)

    def rollout(self, _cmdp, actor):
        """Episodes, and their mean cost [1]."""
        data = play(actor)
        reward = self._sum(self.rewards, data["action"])
        # noise keeps the spread of the rewards, in units of which multipliers weigh costs
        data["next", "reward"] = reward + torch.randn_like(reward)
        data["next", "cost_0"] = cost = self._sum(self.costs, data["action"])
        return data, cost.sum(1).mean(0)

    @property
    def cost_keys(self):
        return ["cost_0"]


def _table(*rows):
    return tuple(map(torch.tensor, rows))


# Choice 1 earns 5 per cost, going on to choice 2 earns 1.25 more: probability (5.2/10 - 0.2)/0.8.
ONE_OF_THREE = Knapsack(
    Categorical(3, shape=(1,)),
    _table([0.0, 1.0, 2.0]),
    _table([0.0, 0.2, 1.0]),
    torch.tensor([5.2]),
    _table([0.0, 0.6, 0.4]),
)
# The second component earns 2 per cost, between the two: probability (6/10 - 0.2)/0.5.
TWO_COMPONENTS = Knapsack(
    MultiCategorical([3, 2], shape=(1, 2)),
    _table([0.0, 1.0, 2.0], [0.0, 1.0]),
    _table([0.0, 0.2, 1.0], [0.0, 0.5]),
    torch.tensor([6.0]),
    _table([0.0, 1.0, 0.0], [0.2, 0.8]),
)
