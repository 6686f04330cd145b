"""A policy that holds its actions itself, against the transform with which it was trained."""

import gymnasium
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.envs import ExplorationType, set_exploration_type

import safe_rl
from safe_rl.envs import make_env
from safe_rl.models import HeldActions, make_bounded_actor

LENGTH = 30  # the last decision of an episode has two steps
SMALL = {"num_envs": 2, "frames_per_batch": 80, "frames": 160, "num_threads": 1, "logger": "none"}
SMALL |= {"env.num_steps": LENGTH, "model.hidden_sizes": [8], "transforms": ["action_repeat"]}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("held") / "run"
    return safe_rl.train("PointGoal2", algo="cpo", directory=folder, **SMALL)


def decisions(steps):
    """Sums over the steps of each decision."""
    return [torch.stack(part).sum(0) for part in (steps[n : n + 4] for n in range(0, LENGTH, 4))]


@pytest.mark.parametrize("kind", [ExplorationType.DETERMINISTIC, ExplorationType.RANDOM])
def test_it_has_the_episodes_of_the_transform(run, kind):
    plain = gymnasium.make("Safexp-PointGoal2-v0", config={"num_steps": LENGTH})
    held, policy = run.make_env(seed=7), run.policy
    torch.manual_seed(0)
    with set_exploration_type(kind):
        expected = held.rollout(2 * 8, policy, break_when_any_done=False)[0]
    torch.manual_seed(0)
    for episode in range(2):
        observation, _ = plain.reset(seed=7 if not episode else None)
        policy.reset()
        seen, rewards, costs, is_over = [], [], [], False
        while not is_over:
            seen.append(torch.as_tensor(observation))
            with set_exploration_type(kind), torch.no_grad():
                action = policy(TensorDict(observation=seen[-1]))["action"]
            observation, reward, terminated, truncated, info = plain.step(action.numpy())
            rewards.append(torch.tensor([reward], dtype=torch.float32))
            costs.append(torch.tensor([info["cost"]], dtype=torch.float32))
            is_over = terminated or truncated
        part = expected[8 * episode : 8 * episode + 8]
        assert torch.equal(torch.stack(seen[::4]), part["observation"])
        assert torch.equal(torch.stack(decisions(rewards)), part["next", "reward"])
        assert torch.equal(torch.stack(decisions(costs)), part["next", "cost"])


def test_rows_that_begin_anew_decide_alone():
    bounds = -torch.ones(2), torch.ones(2)
    actor = make_bounded_actor(3, *bounds, hidden_sizes=[8])
    policy = HeldActions(actor, k=3)
    states = [TensorDict(observation=torch.randn(2, 3), batch_size=[2]) for _ in range(3)]
    first = policy(states[0].clone())["action"]
    policy.reset(torch.tensor([False, True]))
    second = policy(states[1].clone())["action"]
    assert torch.equal(second[0], first[0])
    assert torch.equal(second[1], actor(states[1].clone())["action"][1])
    states[2]["is_init"] = torch.tensor([[True], [False]])
    third = policy(states[2].clone())["action"]
    assert torch.equal(third[0], actor(states[2].clone())["action"][0])
    assert torch.equal(third[1], second[1])


def test_in_an_environment_that_holds_actions_it_decides_at_every_call():
    env = make_env("PointGoal1", num_envs=2, seed=0, num_steps=20, num_threads=1)
    size, bounds = env.observation_spec["observation"].shape[-1], (-torch.ones(2), torch.ones(2))
    policy = HeldActions(make_bounded_actor(size, *bounds, hidden_sizes=[8]), k=4)
    actions = env.rollout(8, policy)["action"]
    assert torch.equal(actions[:, 0], actions[:, 3])
    assert not torch.equal(actions[:, 3], actions[:, 4])
    slow = {"slow": {"_target_": "safe_rl.envs.transforms.ActionRepeat", "k": 4}}
    env = make_env("PointGoal1", num_envs=2, seed=0, num_threads=1, transforms=slow)
    actions = env.rollout(3, policy)["action"]
    assert not torch.equal(actions[:, 0], actions[:, 1])


def test_the_state_of_a_recurrent_policy_is_held_with_its_action():
    counting = TensorDictModule(
        lambda memory: (memory, memory + 1), ["memory"], ["action", ("next", "memory")]
    )
    policy, state, steps = HeldActions(counting, k=2), torch.zeros(2, 1), []
    for number in range(6):
        steps.append(policy(TensorDict(memory=state, batch_size=[2])))
        state = steps[-1]["next", "memory"]
        steps[-1]["next", "reward"] = torch.full((2, 1), float(number))
    assert [step["action"][0].item() for step in steps] == [0, 0, 1, 1, 2, 2]
    assert [step["next", "reward"][0].item() for step in steps] == [0, 1, 2, 3, 4, 5]
