"""Parts put together by hand, with entries below another one, learn what they do without."""

from functools import partial

import pytest
import torch
from samples import LIMITS, make_actor, make_critic, make_rollout
from tensordict import TensorDict

from safe_rl.algorithms import Constraints, MinibatchUpdate, OnPolicy
from safe_rl.collectors import EpisodeAccounting
from safe_rl.objectives import (
    CostGAE,
    CriticLoss,
    CVaR,
    LagrangeMultiplier,
    LimitTracker,
    PPOLagrangianLoss,
    VectorGAE,
)

SETTINGS = {"gamma": 0.99, "lmbda": 0.97, "value_target": "lambda_return"}
TRACKER = LIMITS | {"max_length": 5, "free_steps": 0, "descent_steps": 100, "frames": 1000}
WRITTEN = {
    "actor": {"action": "action", "log_prob": "action_log_prob"},
    "critic": {"out_key": "state_value"},
    "cost_critic": {"out_key": "cost_value"},
    "advantage": {"advantage": "advantage", "value_target": "value_target", "value": "state_value",
                  "reward": "reward", "done": "done", "terminated": "terminated"},
    "cost_advantage": {"advantage": "cost_advantage", "value_target": "cost_value_target",
                       "value": "cost_value", "done": "done", "terminated": "terminated"},
    "loss": {"action": "action", "sample_log_prob": "action_log_prob", "advantage": "advantage",
             "cost_advantage": "cost_advantage"},
    "critic_loss": {"value": "state_value", "value_target": "value_target",
                    "cost_value": "cost_value", "cost_value_target": "cost_value_target"},
}  # fmt: skip


def make_algorithm(below, parts):
    """PPO-Lagrangian whose every entry is `below` a key, or at the root."""

    def at(name):
        return (*below, name) if below else name

    def keys(part):
        return {name: at(key) for name, key in WRITTEN[part].items()}

    torch.manual_seed(0)
    actor = make_actor(at("observation"), **keys("actor"))
    critic = make_critic(in_key=at("observation"), **keys("critic"))
    cost_critic = make_critic(in_key=at("observation"), **keys("cost_critic"))
    constraints = constraints_of(at, parts)
    advantage = VectorGAE(critic, **SETTINGS)
    cost_advantage = CostGAE([at("cost")], cost_critic, **SETTINGS)
    multiplier = LagrangeMultiplier({at("cost"): 1.0}, init=1.0, lr=0.1)
    loss = PPOLagrangianLoss(actor, multiplier, clip_epsilon=0.2, entropy_coeff=0.0)
    critic_loss = CriticLoss(critic, cost_critic)
    for part, given in (
        (advantage, "advantage"), (cost_advantage, "cost_advantage"), (loss, "loss"),
        (critic_loss, "critic_loss"),
    ):  # fmt: skip
        part.set_keys(**keys(given))
    update = partial(
        MinibatchUpdate, optimizer=partial(torch.optim.SGD, lr=0.1), num_passes=2,
        minibatch_size=None,
    )  # fmt: skip
    return OnPolicy(
        actor, critic, cost_critic, constraints, multiplier, advantage, cost_advantage,
        update(loss), update(critic_loss),
    )  # fmt: skip


def make_batch(algorithm, below):
    torch.manual_seed(1)
    done = (torch.arange(10) % 5 == 4).expand(4, 10).unsqueeze(-1)
    batch = make_rollout([], 4, 10, done=done)
    batch["next", "cost"] = 3.0 * (batch["next", "cost"] > 0.5)
    if below:
        following = {below[0]: batch.pop("next")}
        batch = TensorDict({below[0]: batch, "next": following}, [4, 10])
    with torch.no_grad():
        return algorithm.actor(batch)


def constraints_of(at, parts):
    given = {}
    if parts != "plain":
        given["tracker"] = LimitTracker(torch.tensor([1.0]), **TRACKER)
    if parts == "tracker and risk":
        given["risk"] = CVaR(torch.tensor([1.0]), tail=0.5, window=10)
    return Constraints({at("cost"): 1.0}, done_key=at("done"), **given)


@pytest.mark.parametrize("parts", ["plain", "tracker", "tracker and risk"])
def test_entries_below_another_one_are_learned_from_as_at_the_root(parts):
    rows, learned, advantages = [], [], []
    for below in ((), ("agents",)):
        algorithm = make_algorithm(below, parts)
        batch = make_batch(algorithm, below)
        keys = [(*below, name) for name in ("cost", "reward", "done")]
        accounting = EpisodeAccounting(4, keys[:1], reward_key=keys[1], done_key=keys[2])
        row = algorithm.learn(batch, accounting.update(batch))
        rows.append({name.replace("agents/", ""): value for name, value in row.items()})
        learned.append(torch.cat([p.detach().flatten() for p in algorithm.actor.parameters()]))
        advantages.append(batch[(*below, "cost_advantage")])
    assert rows[0] == rows[1]
    assert torch.equal(*learned)
    assert torch.equal(*advantages)
