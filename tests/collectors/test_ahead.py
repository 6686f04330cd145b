"""Batches that are collected while the ones before are learned from."""

from copy import deepcopy
from functools import partial
from itertools import pairwise

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn

from safe_rl.collectors import make_process_collector
from safe_rl.collectors.ahead import behind
from safe_rl.envs import SafetyGymEnv
from safe_rl.models import BehaviourPolicy, ExploringPolicy, make_actor, make_bounded_actor

MAKE = partial(SafetyGymEnv, "PointGoal1", seed=3, num_threads=1)
NUMBERS = {"frames_per_batch": 80, "num_collectors": 1, "device": "cpu"}
BOUNDS = -torch.ones(2), torch.ones(2)


def make_actor_for(env):
    size = env.observation_spec["observation"].shape[-1]
    return make_actor(size, 2, hidden_sizes=[8], initial_log_std=-0.5)


@torch.no_grad()
def test_a_batch_is_of_the_policy_before_the_last_update():
    env = MAKE(num_envs=4)
    actor = make_actor_for(env)
    collector = make_process_collector(env, MAKE, BehaviourPolicy(actor), ahead=True, **NUMBERS)
    actor.load_state_dict(make_actor_for(env).state_dict())  # as a run does that is resumed
    assert collector.updates_behind == 1
    batches = iter(collector)
    before = deepcopy(actor)  # what the batch is of
    kept = []
    for _ in range(4):
        batch = next(batches)
        log_prob = before.get_dist(batch).log_prob(batch["action"])
        torch.testing.assert_close(batch["action_log_prob"], log_prob)
        # but measured from the present policy
        present = actor.get_dist(batch).base_dist
        torch.testing.assert_close(batch["loc"], present.loc)
        torch.testing.assert_close(batch["scale"], present.scale.expand_as(batch["scale"]))
        kept.append((batch, batch.clone()))
        before.load_state_dict(actor.state_dict())
        for parameter in actor.parameters():
            parameter.add_(0.1)
    collector.shutdown()
    for batch, copy in kept:  # the worker has not written into them since
        assert (batch == copy).all()
    for (one, _), (other, _) in pairwise(kept):
        assert torch.equal(other["observation"][:, 0], one["next", "observation"][:, -1])


@torch.no_grad()
def test_a_copy_ceases_to_act_at_random_with_its_policy():
    actor = make_bounded_actor(3, *BOUNDS, hidden_sizes=[8])
    policy = ExploringPolicy(actor, *BOUNDS)
    policy.is_random.fill_(True)
    acting, _, refresh = behind(policy, ["action"])
    steps = TensorDict(observation=torch.randn(5, 3), batch_size=[5])
    own = actor(steps.clone())["action"]
    at_random = acting(steps.clone())
    assert not torch.isclose(at_random["action"], own).any()
    policy.is_random.fill_(False)
    refresh(at_random)
    torch.testing.assert_close(acting(steps.clone())["action"], own)


def test_a_policy_with_a_memory_is_refused():
    env = MAKE(num_envs=4)
    remembers = TensorDictSequential(
        TensorDictModule(nn.Identity(), ["observation"], [("next", "hidden")]),
        BehaviourPolicy(make_actor_for(env)),
    )
    with pytest.raises(ValueError, match=r"memory .*hidden.*ahead=false"):
        make_process_collector(env, MAKE, remembers, ahead=True, **NUMBERS)
