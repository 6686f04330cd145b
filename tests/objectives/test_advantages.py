"""Advantages against a step-by-step loop written from the definition."""

import pytest
import torch
from samples import make_critic, make_rollout
from tensordict import TensorDict

from safe_rl.objectives.advantages import CostGAE, JointAdvantages, VectorGAE
from safe_rl.objectives.gae import normalise_advantages

N, T = 4, 37  # of rollouts


def loop_gae(reward, value, next_value, done, terminated, gamma, lmbda):
    advantage = torch.zeros_like(reward)
    for n in range(reward.shape[0]):
        running = 0.0
        for t in reversed(range(reward.shape[1])):
            bootstrap = 0.0 if terminated[n, t] else next_value[n, t]
            error = reward[n, t] + gamma * bootstrap - value[n, t]
            running = error + (0.0 if done[n, t] else gamma * lmbda * running)
            advantage[n, t] = running
    return advantage


def expected(rollout, reward, value, gamma, lmbda):
    """Advantages, and returns to go, which are values and advantages without a decay."""
    following = rollout["next"]
    given = rollout[value], following[value], following["done"], following["terminated"]
    advantage, undecayed = (loop_gae(reward, *given, gamma, decay) for decay in (lmbda, 1.0))
    return advantage, rollout[value] + undecayed


@pytest.mark.parametrize("precomputed", [False, True])
@pytest.mark.parametrize("lmbda", [0.0, 0.9, 0.97, 1.0])
def test_reward_advantage_and_targets(lmbda, precomputed):
    critic = make_critic()
    rollout = make_rollout([critic])
    advantage, to_go = expected(rollout, rollout["next", "reward"], "state_value", 0.95, lmbda)
    targets = {"lambda_return": advantage + rollout["state_value"], "return_to_go": to_go}
    for name, target in targets.items():
        data = rollout.clone()
        if not precomputed:
            del data["state_value"], data["next", "state_value"]
        network = None if precomputed else critic
        out = VectorGAE(network, gamma=0.95, lmbda=lmbda, value_target=name)(data)
        torch.testing.assert_close(out["advantage"], advantage, atol=1e-5, rtol=1e-5)
        torch.testing.assert_close(out["value_target"], target, atol=1e-5, rtol=1e-5)
        torch.testing.assert_close(out["state_value"], rollout["state_value"])
        assert not out["advantage"].requires_grad
    single = VectorGAE(critic, gamma=0.95, lmbda=lmbda, value_target=name)(rollout[0].clone())
    torch.testing.assert_close(single["advantage"], advantage[0], atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("keys", [["cost"], ["cost_hazards", "cost_vases"], ["a", ("b", "c"), "d"]])
def test_k_costs_at_once(keys):
    critic = make_critic("cost_value", len(keys))
    rollout = make_rollout([critic], costs=keys)
    estimator = CostGAE(keys, critic, gamma=0.99, lmbda=0.95, value_target="return_to_go")
    costs = torch.cat([rollout["next", *([k] if isinstance(k, str) else k)] for k in keys], -1)
    advantage, target = expected(rollout, costs, "cost_value", 0.99, 0.95)
    out = estimator(rollout.select("observation", "next"))
    torch.testing.assert_close(out["cost_advantage"], advantage, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(out["cost_value_target"], target, atol=1e-5, rtol=1e-5)


def test_trajectories_behind_each_other_are_not_one():
    """As of workers with one environment each, in one dimension of time."""
    critic = make_critic()
    estimator = VectorGAE(critic, gamma=0.9, lmbda=0.9, value_target="lambda_return")
    rollout = make_rollout([critic])
    ids = torch.tensor([2, 0, 3, 1]).unsqueeze(-1).expand(N, T)
    for given in (ids, ids.unsqueeze(-1)):
        rollout["collector", "traj_ids"] = given
        found = estimator(rollout.reshape(-1))["advantage"].reshape(N, T, 1)
        torch.testing.assert_close(found, estimator(rollout)["advantage"])


def test_each_observation_is_valued_once():
    critic = make_critic()
    rollout = make_rollout([critic])
    valued = []
    critic.register_forward_hook(lambda _module, args, _out: valued.append(args[0].numel()))
    VectorGAE(critic, gamma=0.9, lmbda=0.9, value_target="lambda_return")(rollout)
    ends = rollout["next", "done"].squeeze(-1).clone()
    ends[:, -1] = True
    assert sum(valued) == N * T + ends.sum()


@pytest.mark.parametrize("size", [1.0, 1e-4])
def test_normalisation(size):
    batch = TensorDict(
        advantage=size * (5 + 3 * torch.randn(6, 50, 1)),
        cost_advantage=torch.tensor([2.0, 40.0]) * (torch.randn(6, 50, 2) + 1),
        batch_size=[6, 50],
    )
    scale = batch["cost_advantage"].flatten(0, 1).std(0)
    normalise_advantages(batch)
    torch.testing.assert_close(batch["advantage"].mean(), torch.tensor(0.0), atol=1e-6, rtol=0)
    torch.testing.assert_close(batch["advantage"].std(correction=0), torch.tensor(1.0))
    costs = batch["cost_advantage"].flatten(0, 1)
    torch.testing.assert_close(costs.mean(0), torch.zeros(2), atol=1e-5, rtol=0)
    torch.testing.assert_close(costs.std(0), scale)


@pytest.mark.parametrize("constant", [7.0, 12345.678])  # the mean of the second is rounded
def test_normalisation_of_a_constant_advantage_is_zero(constant):
    batch = TensorDict(advantage=torch.full((1003, 1), constant), batch_size=[1003])
    assert normalise_advantages(batch)["advantage"].abs().max() < 0.2


def test_errors_say_what_to_change():
    settings = {"gamma": 0.99, "lmbda": 0.97, "value_target": "lambda_return"}
    with pytest.raises(ValueError, match="lambda_return"):
        VectorGAE(None, **{**settings, "value_target": "montecarlo"})
    for keys in ([], "cost_hazard"):
        with pytest.raises(ValueError, match="cost_keys must be a list"):
            CostGAE(keys, None, **settings)
    cost = CostGAE(["cost_hazard"], make_critic("cost_value"), **settings)
    rollout = make_rollout([], costs=("cost_hazards", "cost_vases"))
    with pytest.raises(KeyError, match=r"Did you mean \('next', 'cost_hazards'\)"):
        cost(rollout)
    cost.set_keys(reward=["cost_hazards", "cost_vases"])
    with pytest.raises(ValueError, match="one output per signal"):
        cost(rollout)
    for reward in (VectorGAE(make_critic("cost_value"), **settings), VectorGAE(None, **settings)):
        with pytest.raises(KeyError, match=r"No entry .*state_value"):
            reward(rollout)
    for keys in (["reward"], ["reward", "done", "terminated"]):  # the last dimension but one
        of_agents = rollout.clone()
        for key in keys:
            of_agents["next", key] = of_agents["next", key].unsqueeze(-2).expand(N, T, 3, 1)
        with pytest.raises(ValueError, match=r"In a rollout \[4, 37\], .* agents"):
            reward(of_agents)
    cost.set_keys(reward=["cost_hazards"])
    with pytest.raises(ValueError, match=r"'time' must be the last .* \['time', None\]"):
        cost(rollout.clone().refine_names("time", None))
    rollout["next", "cost_hazards"] = rollout["next", "cost_hazards"].squeeze(-1)
    with pytest.raises(ValueError, match=r"shapes \[\[4, 37\]\] and .* use unsqueeze\(-1\)"):
        cost(rollout)


def test_both_advantages_come_from_one_call_under_keys_of_ones_own():
    settings = {"gamma": 0.95, "lmbda": 0.9, "value_target": "lambda_return"}
    parts = VectorGAE(make_critic(), **settings), CostGAE(["cost"], make_critic("c"), **settings)
    parts[1].set_keys(value="c")
    rollout = make_rollout([])
    expected = normalise_advantages(parts[1](parts[0](rollout.clone())))
    both = JointAdvantages(*parts)
    both.set_keys(advantage="a")
    parts[1].set_keys(advantage="b")
    found = both(rollout)
    for key, own in (("advantage", "a"), ("cost_advantage", "b")):
        torch.testing.assert_close(found[own], expected[key])
