"""A constrained problem whose optimal policy is known in closed form.

Episodes of `STEPS` steps with one state. An action a ∈ R² earns −‖a − target‖² and incurs the
costs W a, so that for a Gaussian policy of mean μ and fixed width the return is, but for a
constant, −STEPS·‖μ − target‖² and the episode costs are STEPS·W μ. The optimal feasible μ is the
Euclidean projection of the target onto {W μ ≤ limits / STEPS}.
"""

from dataclasses import dataclass

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType
from torchrl.modules import IndependentNormal, ProbabilisticActor

from safe_rl.objectives import CostGAE, CriticLoss, VectorGAE, normalise_advantages

STEPS, EPISODES, SCALE = 10, 200, 0.3
TARGET = torch.tensor([1.0, 0.5])


@dataclass(frozen=True)
class CMDP:
    weights: Tensor  # W, [k, 2]
    limits: Tensor  # undiscounted cost per episode, [k]
    optimum: Tensor  # μ*, [2]

    @property
    def cost_keys(self):
        return [f"cost_{i}" for i in range(len(self.limits))]

    @property
    def cost_limits(self):
        return dict(zip(self.cost_keys, self.limits.tolist(), strict=True))

    def expected_costs(self, mean):
        return STEPS * self.weights @ mean


# One constraint μ₁ ≤ 0.4: the projection moves along the first axis only.
ONE = CMDP(torch.tensor([[1.0, 0.0]]), torch.tensor([4.0]), torch.tensor([0.4, 0.5]))
# A second one, 0.3 μ₁ + μ₂ ≤ 0.35: both are active, μ* is where their boundaries meet. (Their
# multipliers there, 1.038 and 0.54, solve 2(target − μ*) = Wᵀν and are positive.)
TWO = CMDP(
    torch.tensor([[1.0, 0.0], [0.3, 1.0]]), torch.tensor([4.0, 3.5]), torch.tensor([0.4, 0.23])
)


class FixedWidthMean(nn.Linear):
    """Mean linear in the observation, constant standard deviation."""

    def forward(self, observation):
        loc = super().forward(observation)
        return loc, torch.full_like(loc, SCALE)


def make_actor():
    net = FixedWidthMean(1, 2)
    nn.init.zeros_(net.weight)
    nn.init.zeros_(net.bias)
    return ProbabilisticActor(
        TensorDictModule(net, in_keys=["observation"], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=IndependentNormal,
        default_interaction_type=ExplorationType.RANDOM,
        return_log_prob=True,
    )


def policy_mean(actor):
    with torch.no_grad():
        return actor.get_dist(TensorDict(observation=torch.ones(1, 1), batch_size=[1])).mean[0]


def play(actor):
    """Whole episodes, [EPISODES, STEPS], cut by a time limit; without rewards and costs."""
    shape = (EPISODES, STEPS)
    data = TensorDict(observation=torch.ones(*shape, 1), batch_size=shape)
    with torch.no_grad():
        actor(data)
    done = torch.zeros(*shape, 1, dtype=torch.bool)
    done[:, -1] = True
    ends = {"done": done, "terminated": torch.zeros_like(done)}
    data["next"] = TensorDict({"observation": torch.ones(*shape, 1), **ends}, shape)
    return data


def rollout(cmdp, actor):
    """Episodes, and their mean costs [k]."""
    data = play(actor)
    data["next", "reward"] = -(data["action"] - TARGET).square().sum(-1, keepdim=True)
    costs = data["action"] @ cmdp.weights.T
    for key, cost in zip(cmdp.cost_keys, costs.split(1, -1), strict=True):
        data["next", key] = cost
    return data, costs.sum(1).mean(0)


def train(cmdp, actor, update, epochs, rollout=rollout, mean=policy_mean):
    """Run epochs of rollout, advantages, policy update and critic fit.

    `update(batch, mean_costs)` changes the actor. Returns the means of the policy after every
    epoch, [epochs, 2], or what another function says of it.
    """
    num_costs = len(cmdp.limits)
    critic = TensorDictModule(nn.Linear(1, 1), ["observation"], ["state_value"])
    cost_critic = TensorDictModule(nn.Linear(1, num_costs), ["observation"], ["cost_value"])
    settings = {"gamma": 0.9, "lmbda": 0.3, "value_target": "lambda_return"}
    estimators = VectorGAE(critic, **settings), CostGAE(cmdp.cost_keys, cost_critic, **settings)
    critic_loss = CriticLoss(critic, cost_critic)
    adam = torch.optim.Adam(critic_loss.parameters(), lr=0.1)
    means = []
    for _ in range(epochs):
        data, mean_costs = rollout(cmdp, actor)
        for estimator in estimators:
            estimator(data)
        update(normalise_advantages(data), mean_costs)
        means.append(mean(actor))
        for _ in range(10):
            losses = critic_loss(data)
            adam.zero_grad()
            (losses["loss_critic"] + losses["loss_cost_critic"]).backward()
            adam.step()
    return torch.stack(means)
