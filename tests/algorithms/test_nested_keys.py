"""Parts put together by hand, with entries below another one, learn what they do without."""

from dataclasses import dataclass
from functools import partial

import pytest
import torch
from point_mass import PointMass
from run_configs import point_mass_config
from samples import make_actor, make_critic
from tensordict import NestedKey, TensorDict

from safe_rl.algorithms import MinibatchUpdate, OnPolicy
from safe_rl.algorithms.constraints import Constraints, TrackedConstraints
from safe_rl.collectors import EpisodeAccounting
from safe_rl.objectives import (
    CostGAE,
    CriticLoss,
    LagrangeMultiplier,
    LimitTracker,
    PPOLagrangianLoss,
    VectorGAE,
)
from safe_rl.trust import allow

SETTINGS = {"gamma": 0.99, "lmbda": 0.97, "value_target": "lambda_return"}
TRACKER = {
    "max_length": 5, "margin": 0.5, "largest_margin": 0.2, "free_steps": 0, "descent_steps": 100,
    "frames": 1000, "latest_end": 0.7, "smallest_scale": 0.01, "drift": 0.2, "memory": 0.9,
    "lowest_trust": 0.1, "integral": 0.0, "largest_integral": 0.5,
}  # fmt: skip
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


def make_algorithm(below, constraints_of):
    """PPO-Lagrangian whose every entry is `below` a key, or at the root."""

    def at(name):
        return (*below, name) if below else name

    def keys(part):
        return {name: at(key) for name, key in WRITTEN[part].items()}

    torch.manual_seed(0)
    actor = make_actor(at("observation"), **keys("actor"))
    critic = make_critic(in_key=at("observation"), **keys("critic"))
    cost_critic = make_critic(in_key=at("observation"), **keys("cost_critic"))
    constraints = constraints_of(at)
    advantage = VectorGAE(critic, **SETTINGS)
    cost_advantage = CostGAE([at("cost")], cost_critic, **SETTINGS)
    loss = PPOLagrangianLoss(actor, constraints.multiplier, clip_epsilon=0.2, entropy_coeff=0.0)
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
        actor, critic, cost_critic, constraints, advantage, cost_advantage,
        update(loss), update(critic_loss),
    )  # fmt: skip


def make_batch(algorithm, below):
    generator = torch.Generator().manual_seed(1)
    draw = partial(torch.randn, 4, 10, generator=generator)
    done = torch.zeros(4, 10, 1, dtype=torch.bool)
    done[:, 4::5] = True
    following = {"observation": draw(3), "reward": draw(1), "done": done, "terminated": done}
    following["cost"] = 3.0 * (draw(1) > 0)
    here = {"observation": draw(3)}
    if below:
        here, following = {below[0]: here}, {below[0]: following}
    batch = TensorDict({**here, "next": following}, [4, 10])
    torch.manual_seed(2)
    with torch.no_grad():
        return algorithm.actor(batch)


def plain(at):
    multiplier = LagrangeMultiplier({at("cost"): 1.0}, init=1.0, lr=0.1)
    return Constraints({at("cost"): 1.0}, multiplier=multiplier)


def tracked(at):
    constraints = TrackedConstraints(
        {at("cost"): 1.0},
        tracker=LimitTracker(torch.tensor([1.0]), **TRACKER),
        multiplier=LagrangeMultiplier({at("cost"): 1.0}, init=1.0, lr=0.1),
    )
    constraints.cost_advantage = at("cost_advantage")
    return constraints


@pytest.mark.parametrize("constraints_of", [plain, tracked])
def test_entries_below_another_one_are_learned_from_as_at_the_root(constraints_of):
    rows, learned, advantages = [], [], []
    for below in ((), ("agents",)):
        algorithm = make_algorithm(below, constraints_of)
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


class CostsElsewhere(CostGAE):
    """Writes its advantages to where its own loss looks for them."""

    @dataclass
    class _AcceptedKeys:
        advantage: NestedKey = ("costs", "advantage")
        value_target: NestedKey = "cost_value_target"
        value: NestedKey = "cost_value"
        reward: NestedKey | list[NestedKey] = "cost"
        done: NestedKey = "done"
        terminated: NestedKey = "terminated"

    default_keys = _AcceptedKeys


def test_a_recipe_weighs_cost_advantages_where_its_estimator_writes_them():
    allow(__name__)
    config = point_mass_config(f"cost_advantage._target_={__name__}.CostsElsewhere")
    algorithm = OnPolicy.from_config(config, PointMass(4))
    assert algorithm.constraints.cost_advantage == ("costs", "advantage")
