"""What Gymnasium environments of somebody's may return, and what is said of it."""

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box

from safe_rl.envs import ConfigError, from_gymnasium


class Faulty(gymnasium.Env):
    """Keeps the rules until its fault is due."""

    observation_space, action_space = Box(-1, 1, (3,), np.float32), Box(-1, 1, (1,), np.float32)

    def __init__(self, fault, first=2):
        self.fault, self.first, self.steps = fault, first, 0

    def reset(self, *, seed=None, options=None):
        return np.zeros(3, np.float32), {}

    def step(self, action):
        self.steps += 1
        step = {"observation": np.zeros(3, np.float32), "reward": 1.0, "terminated": False,
                "truncated": False, "info": {"cost": 1.0}}  # fmt: skip
        if self.steps >= self.first:
            if self.fault is SystemExit:
                raise SystemExit(3)
            step |= self.fault
        return tuple(step.values())


def roll(fault, first=2, steps=4, **options):
    env = from_gymnasium(lambda: Faulty(fault, first), num_steps=50, seed=0, **options)
    return env.rollout(steps, break_when_any_done=False)


@pytest.mark.parametrize("num_envs", [1, 2])
@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (
            {"observation": np.zeros(4)},
            r"shape \(4,\), where its space is \(3,\)",
        ),
        ({"reward": "much"}, "the reward 'much', which is no number"),
        ({"reward": 1j}, "the reward 1j, which is no number"),
        ({"reward": np.zeros(2)}, "which is no number"),
        ({"terminated": "no"}, "terminated='no', which is neither True nor False"),
        ({"info": None}, "the info None, which is no dictionary"),
        (SystemExit, r"called sys\.exit\(3\)"),
    ],
)
def test_a_faulty_step_is_told_in_a_line(fault, words, num_envs):
    with pytest.raises(ConfigError, match=f"A step of .*{words}"):
        roll(fault, num_envs=num_envs)


@pytest.mark.parametrize(
    "kept", [{"reward": np.float32(1)}, {"reward": 1}, {"terminated": np.bool_(False)}, {}]
)
def test_what_gymnasium_allows_is_taken(kept):
    assert roll(kept)["next", "cost"].sum() == 4


def test_an_exit_at_the_first_step_does_not_end_the_program():
    with pytest.raises(ValueError, match=r"called sys\.exit\(3\)"):
        roll(SystemExit, first=1)


def test_a_cost_that_is_reported_no_more_is_warned_of():
    with pytest.warns(UserWarning, match="each of the first 20 steps and is missing now"):
        steps = roll({"info": {}}, first=21, steps=25)
    assert steps["next", "cost"].sum() == 20


def test_a_cost_that_is_reported_where_it_occurs_is_not_warned_of(recwarn):
    roll({"info": {}}, first=3, steps=10, cost_keys=["cost"])
    assert not [w for w in recwarn if "missing now" in str(w.message)]
