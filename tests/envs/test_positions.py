"""Positions in public, against what rewards and costs say about them."""

import pytest
import torch

from safe_rl.envs import SUITE, SafetyGymEnv


def test_pinned_objects_are_where_they_were_put():
    places = [(1.0, 1.0), (-1.0, 0.5)]
    config = SUITE["PointGoal1"].replace(
        hazards_num=2, hazards_locations=places, robot_locations=[(0.0, -1.0)]
    )
    env = SafetyGymEnv(config, num_envs=3, seed=0)
    env.reset()
    positions = env.get_positions()
    assert positions.batch_size == (3,)
    assert sorted(positions.keys()) == ["goal", "hazards", "robot", "vases"]
    assert {key: value.shape[1] for key, value in positions.items()} == {
        **{"robot": 1, "goal": 1},
        **{"hazards": 2, "vases": 1},
    }
    expected = torch.tensor(places, dtype=torch.float64).expand(3, -1, -1)
    torch.testing.assert_close(positions["hazards"][..., :2], expected, rtol=0, atol=1e-6)
    robot = torch.tensor([0.0, -1.0, 0.1], dtype=torch.float64).expand(3, 1, 3)
    torch.testing.assert_close(positions["robot"], robot, rtol=0, atol=1e-6)
    vase = torch.full((3, 1), 0.1 - 4e-5, dtype=torch.float64)  # half side less what it sinks in
    torch.testing.assert_close(positions["vases"][..., 2], vase, rtol=0, atol=1e-6)


def test_they_are_copies():
    env = SafetyGymEnv("PointGoal1", num_envs=2, seed=0)
    env.reset()
    before = env.get_positions()
    env.get_positions().zero_()
    assert (env.get_positions() == before).all()
    env.rollout(20)
    assert (env.get_positions()["robot"] != before["robot"]).any()


@pytest.mark.parametrize("name", ["CarGoal2", "DoggoButton2", "PointPush2"])
def test_costs_and_rewards_follow_from_them(name):
    env = SafetyGymEnv(SUITE[name].replace(hazards_size=0.9, goal_size=0.01), num_envs=8, seed=0)
    tensordict, seen = env.reset(), 0
    for _ in range(30):
        before = env.get_positions()
        tensordict = env.rand_action(tensordict)
        following = env.step(tensordict)["next"]
        now = env.get_positions()
        to_hazards = (now["hazards"] - now["robot"])[..., :2].norm(dim=-1)
        inside = (to_hazards <= 0.9).any(-1, keepdim=True)
        assert torch.equal(following["cost_hazards"] > 0, inside)
        seen += int(inside.sum())
        if name == "CarGoal2":
            old, new = ((p["goal"] - p["robot"])[:, 0, :2].norm(dim=-1) for p in (before, now))
            torch.testing.assert_close(
                following["reward"][:, 0].double(), old - new, rtol=0, atol=1e-6
            )
        tensordict = following
    assert seen > 0
