"""The example of a loss of one's own: CVaR against its definition, and whole runs."""

import re
import shlex
import subprocess
import sys

import pytest
import torch
from point_mass import PointMass
from run_configs import CONF, point_mass_config
from scipy.stats import norm
from tensordict import TensorDict
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
from torch import nn
from torchrl.modules import IndependentNormal, ProbabilisticActor

from safe_rl.cli.user_code import import_modules
from safe_rl.objectives import LagrangeMultiplier
from safe_rl.runs.table import read_table
from safe_rl.targets import allow
from safe_rl.training.trainer import build_trainer

ROOT = CONF.parent
EXAMPLES = ROOT / "examples"
import_modules([str(EXAMPLES / "custom_loss.py")])

import custom_loss  # noqa: E402

allow("custom_loss")

DISCOUNT = {"gamma": 0.9, "lmbda": 0.8, "value_target": "lambda_return"}


def worst_mean(costs, tail):
    """Mean of the worst fraction of a list: the episode on its edge counts in part."""
    left, total = tail * len(costs), 0.0
    for cost in sorted(costs, reverse=True):
        weight = min(1.0, left)
        total += weight * cost
        left -= weight
    return total / (tail * len(costs))


@pytest.mark.parametrize("tail", [0.05, 0.25, 0.3, 0.5, 1.0])
@pytest.mark.parametrize("episodes", [1, 7, 20])
def test_cvar_is_the_mean_of_the_worst_episodes(tail, episodes):
    costs = torch.randint(0, 6, (episodes, 2)).double()  # with ties
    expected = [worst_mean(column, tail) for column in costs.T.tolist()]
    cvar = custom_loss.conditional_value_at_risk(costs, tail)
    assert cvar.tolist() == pytest.approx(expected)
    if tail == 1:
        torch.testing.assert_close(cvar, costs.mean(0))


def rollout_of(costs, done):
    """A rollout [N, T] without rewards; costs [N, T, k], done [N, T, 1]."""
    following = {f"cost_{i}": cost for i, cost in enumerate(costs.split(1, -1))}
    following |= {"done": done, "terminated": torch.zeros_like(done)}
    following["cost_value"] = torch.randn(costs.shape)
    entries = {"next": following, "cost_value": torch.randn(costs.shape)}
    return TensorDict(entries, batch_size=costs.shape[:2])


def brute_force_tail_costs(costs, ends, tail):
    """Steps of one cost, lists [N][T]: growth of (cost so far − ν)₊ / α, step by step."""
    totals, total = [], 0.0
    for row, row_ends in zip(costs, ends, strict=True):
        for cost, end in zip(row, row_ends, strict=True):
            total += cost
            if end:
                totals.append(total)
                total = 0.0

    def expression(nu):
        return nu + sum(max(cost - nu, 0) for cost in totals) / len(totals) / tail

    # the lowest of those that minimise Rockafellar and Uryasev's expression
    threshold = min(totals, key=lambda nu: (round(expression(nu), 9), nu))
    result, spent = [], 0.0
    for row, row_ends in zip(costs, ends, strict=True):
        for cost, end in zip(row, row_ends, strict=True):
            before, spent = spent, spent + cost
            result.append((max(spent - threshold, 0) - max(before - threshold, 0)) / tail)
            spent = 0.0 if end else spent
    return result, totals, threshold


@pytest.mark.parametrize("tail", [0.2, 0.5])
def test_tail_costs_by_hand(tail):
    costs = torch.rand(3, 12, 2) * torch.randint(0, 3, (3, 12, 2))
    done = torch.rand(3, 12, 1) < 0.2
    rollout = rollout_of(costs, done)
    estimator = custom_loss.TailCostGAE(["cost_0", "cost_1"], None, tail=tail, **DISCOUNT)
    estimator(rollout)
    ends = done.squeeze(-1).clone()
    ends[:, -1] = True
    for i in range(2):
        column = rollout["next", "tail_cost"][..., i]
        expected, totals, threshold = brute_force_tail_costs(
            costs[..., i].tolist(), ends.tolist(), tail
        )
        torch.testing.assert_close(column.flatten(), torch.tensor(expected))
        beyond = column.sum() / len(totals) + threshold
        assert beyond.item() == pytest.approx(worst_mean(totals, tail), rel=1e-5)
    # the last step's advantage is its TD error
    values, following = rollout["cost_value"], rollout["next", "cost_value"]
    error = rollout["next", "tail_cost"] + 0.9 * following - values
    torch.testing.assert_close(rollout["cost_advantage"][:, -1], error[:, -1])


STEPS, EPISODES, TAIL = 5, 40_000, 0.25


def normal_actor():
    """One state, actions N(3, 0.3²)."""
    scale = AddStateIndependentNormalScale(1, init_value=-1.2)
    net = nn.Sequential(nn.Linear(1, 1), scale)
    nn.init.constant_(net[0].weight, 3.0)
    nn.init.zeros_(net[0].bias)
    return ProbabilisticActor(
        TensorDictModule(net, in_keys=["observation"], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=IndependentNormal,
        return_log_prob=True,
    )


def test_the_gradient_is_that_of_cvar_in_closed_form():
    """Step costs N(μ, σ²): C is normal, CVaR = Tμ + √T σ φ(z) / α with z its (1 − α)-quantile."""
    actor = normal_actor()
    data = TensorDict(observation=torch.ones(EPISODES, STEPS, 1), batch_size=[EPISODES, STEPS])
    with torch.no_grad():
        actor(data.select("observation"))
        data["action"] = actor.get_dist(data).sample()
        dist = actor.get_dist(data)
        data["action_log_prob"] = dist.log_prob(data["action"])
        data["loc"], data["scale"] = dist.base_dist.loc, dist.base_dist.scale
    done = torch.zeros(EPISODES, STEPS, 1, dtype=torch.bool)
    done[:, -1] = True
    flags = {"done": done, "terminated": done}
    # a constant value is a baseline, which leaves the expected gradient as it is
    zero = torch.zeros_like(data["action"])
    data["next"] = TensorDict(cost=data["action"], cost_value=zero, **flags)
    data["cost_value"], data["advantage"] = zero, zero
    settings = {"gamma": 1.0, "lmbda": 1.0, "value_target": "lambda_return"}
    custom_loss.TailCostGAE(["cost"], None, tail=TAIL, **settings)(data)
    data["cost_advantage"] -= data["cost_advantage"].mean(0)  # a baseline that depends on time

    multiplier = LagrangeMultiplier(0.0, init=1.0, lr=0.1)
    loss = custom_loss.CVaRPPOLoss(actor, multiplier, clip_epsilon=0.2, entropy_coeff=0.0)
    by_step = torch.autograd.grad(loss(data)["loss_objective"], list(actor.parameters()))
    # λ / (1 + λ) = 1/2 of the mean over steps
    gradient = dict(zip(("weight", "bias", "log_std"), by_step, strict=True))
    slopes = {name: 2 * STEPS * value.item() for name, value in gradient.items()}

    sigma = data["scale"][0, 0].item()
    z = norm.ppf(1 - TAIL)
    assert slopes["bias"] == pytest.approx(STEPS, rel=0.05)
    assert slopes["log_std"] == pytest.approx(STEPS**0.5 * sigma * norm.pdf(z) / TAIL, rel=0.05)
    expected = STEPS * 3.0 + STEPS**0.5 * sigma * norm.pdf(z) / TAIL
    costs = data["next", "cost"].sum(1)
    assert custom_loss.conditional_value_at_risk(costs, TAIL).item() == pytest.approx(
        expected, rel=1e-3
    )


def test_the_loss_is_pessimistic_on_both_sides():
    actor = normal_actor()
    data = TensorDict(observation=torch.ones(64, 1), batch_size=[64])
    with torch.no_grad():
        data["action"] = actor.get_dist(data.clone()).sample()
        data["action_log_prob"] = actor.get_dist(data.clone()).log_prob(data["action"])
    data["loc"], data["scale"] = torch.full((64, 1), 3.0), torch.full((64, 1), 0.3)
    data["advantage"], data["cost_advantage"] = torch.randn(64, 1), torch.randn(64, 2)
    with torch.no_grad():
        actor.module[0].module[0].bias.add_(0.1)
        log_prob = actor.get_dist(data.clone()).log_prob(data["action"])
    multiplier = LagrangeMultiplier([1.0, 1.0], init=[0.5, 2.0], lr=0.1)
    loss = custom_loss.CVaRPPOLoss(actor, multiplier, clip_epsilon=0.2, entropy_coeff=0.0)
    total = 0.0
    for i in range(64):
        ratio = (log_prob[i] - data["action_log_prob"][i]).exp().item()
        clipped = min(max(ratio, 0.8), 1.2)
        reward, (first, second) = data["advantage"][i].item(), data["cost_advantage"][i].tolist()
        gain = min(ratio * reward, clipped * reward)
        penalty = 0.5 * max(ratio * first, clipped * first)
        penalty += 2.0 * max(ratio * second, clipped * second)
        total -= (gain - penalty) / 3.5
    assert loss(data)["loss_objective"].item() == pytest.approx(total / 64, rel=1e-4)
    assert loss(data)["clip_fraction"] > 0


def train(directory, *overrides, limits="{cost_hazards: 1, cost_north: 0.5}"):
    """A run of a second on the point mass, with the example's folder of configurations."""
    config = point_mass_config(
        f"hydra.searchpath=[file://{EXAMPLES / 'conf'}]",
        f"cost_limits={limits}",
        *overrides,
        minibatch_size=None if "algo=cpo" in overrides else 40,
    )
    trainer = build_trainer(config, PointMass(config.num_envs, 20, config.seed), directory)
    trainer.run()
    return trainer, read_table(directory / "progress.csv")


def test_it_trains_with_several_costs(tmp_path):
    trainer, table = train(tmp_path, "algo=cvar_ppo")
    assert isinstance(trainer.algorithm.policy_update.loss, custom_loss.CVaRPPOLoss)
    for key, limit in (("cost_hazards", 1), ("cost_north", 0.5)):
        cvar = [violation + limit for violation in table[f"violation_{key}"]]
        means = table[f"episode_{key}"]
        assert all(worst > mean for worst, mean in zip(cvar, means, strict=True) if mean)
        # eight episodes an epoch: the mean of the worst two, whose costs are whole numbers
        assert all((2 * worst) % 1 == 0 for worst in cvar)
        assert len(set(table[f"multiplier_{key}"])) > 1


def test_a_policy_is_best_only_if_its_worst_episodes_keep_the_limit(tmp_path):
    limit = 8
    _, table = train(tmp_path, "algo=cvar_ppo", limits=f"{{cost_hazards: {limit}}}")
    assert min(table["episode_cost_hazards"]) < limit
    assert min(table["violation_cost_hazards"]) > 0
    assert not (tmp_path / "checkpoints" / "best").exists()


def test_measure_and_estimator_go_with_cpo(tmp_path):
    trainer, table = train(tmp_path, "algo=cpo", "+risk=cvar")
    assert isinstance(trainer.algorithm.cost_advantage, custom_loss.TailCostGAE)
    violations = table["violation_cost_hazards"]
    assert table["policy_c_cost_hazards"] == pytest.approx([v / 20 for v in violations])
    means = table["episode_cost_hazards"]
    assert all(v + 1 > mean for v, mean in zip(violations, means, strict=True) if mean)


def test_without_a_measure_of_ones_own_means_are_limited(tmp_path):
    _, table = train(tmp_path, "algo=ppo_lagrangian", "limits=paper")
    for key, limit in (("cost_hazards", 1), ("cost_north", 0.5)):
        expected = [mean - limit for mean in table[f"episode_{key}"]]
        assert table[f"violation_{key}"] == pytest.approx(expected, abs=1e-5)


def test_the_command_of_the_example(tmp_path):
    command = re.search(r"python train.py .*?\n\n", custom_loss.__doc__, re.DOTALL)
    words = shlex.split(command[0])
    assert words[0] == "python"
    short = [
        *("frames=80", "env.num_steps=20", "num_envs=2", "frames_per_batch=40", "logger=none"),
        *("model.hidden_sizes=[8]", "policy_update.minibatch_size=20"),
        *("critic_update.minibatch_size=20", "num_threads=1", f"hydra.run.dir={tmp_path}"),
    ]
    result = subprocess.run(
        [sys.executable, *words[1:], *short],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    assert "violation_cost" in read_table(tmp_path / "progress.csv")
