"""New goals: where they are drawn, which button they are, and what happens if there is no place."""

import itertools

import numpy as np
import pytest
import torch
from crafting import make, places, position_columns
from scipy import stats
from tensordict import TensorDict

from safe_rl.envs import LayoutError, SafetyGymEnv

# No substeps, and goals that are met wherever they are: every step draws a new one.
ALWAYS_MET = {"robot_base": "point", "frameskip_binom_p": 0.0, "goal_size": 100.0}
UNLIKELY = 1e-3  # p values below this one would be a finding
NUM_ENVS = 1000


def stay(env: SafetyGymEnv, state: TensorDict | None = None) -> TensorDict:
    """One step without any action, from a state or the present."""
    tensordict = TensorDict(batch_size=env.batch_size) if state is None else env.set_state(state)
    return env.step(tensordict.set("action", env.action_spec.zero()))["next"]


def test_new_goals_are_uniform_where_they_fit():
    pins = {"robot_locations": [[0, 0]], "hazards_num": 1, "hazards_locations": [[1, 1]]}
    keepouts = {"goal_keepout": 0.2, "robot_keepout": 0.5, "hazards_keepout": 0.3}
    env = make({**ALWAYS_MET, **pins, **keepouts}, NUM_ENVS)
    goals = []
    for _ in range(4):
        assert stay(env)["goal_met"].all()
        goals.append(env.get_state()["goal_pos"])
    got = torch.cat(goals).numpy()
    assert (got[:, 2] == got[0, 2]).all()
    candidates = np.random.default_rng(0).uniform(-1.8, 1.8, (10_000, 2))
    clear = np.hypot(*candidates.T) >= 0.7
    clear &= np.hypot(*(candidates - 1).T) >= 0.5
    want = candidates[clear]
    for measure in (lambda xy: xy[:, 0], lambda xy: xy[:, 1], lambda xy: np.hypot(*xy[:, :2].T)):
        assert stats.ks_2samp(measure(got), measure(want)).pvalue > UNLIKELY
    # A goal does not tell where the next one is.
    assert stats.spearmanr(goals[0][:, 0], goals[1][:, 0]).pvalue > UNLIKELY


MOVED = {
    "robot": {"robot_keepout": 0.6},
    "vase0": {"vases_num": 1, "vases_keepout": 0.6},
    "box": {"task": "push", "box_keepout": 0.6},
    "gremlin0": {"gremlins_num": 1, "gremlins_keepout": 0.6},
}


@pytest.mark.parametrize("name", MOVED)
def test_new_goals_keep_clear_of_where_things_have_moved(name):
    """A gremlin's place is the centre of its circle, wherever it is on it."""
    env = make({**ALWAYS_MET, **MOVED[name], "goal_keepout": 0.2}, NUM_ENVS)
    state = env.get_state()
    before = places(env, state)[name].clone()
    now = 0.5 * torch.randn(NUM_ENVS, 2, dtype=torch.float64)
    state["qpos"][:, position_columns(env)[name]] = now
    assert stay(env, state)["goal_met"].all()
    goal = env.get_state()["goal_pos"][:, :2]
    kept, free = (before, now) if name == "gremlin0" else (now, before)
    assert (goal - kept).norm(dim=-1).min() >= 0.8 - 1e-9
    assert ((goal - free).norm(dim=-1) < 0.8).any(), "the other place was kept clear"


def test_goal_buttons_are_uniform_and_forget_the_last_one():
    # Buttons so large that the robot stands in all of them.
    config = {
        **{"robot_base": "point", "task": "button", "buttons_num": 4, "buttons_size": 1.0},
        **{"placements_extents": [-0.2, -0.2, 0.2, 0.2], "frameskip_binom_p": 0.0},
        **{"buttons_keepout": 0.0, "robot_keepout": 0.0},
    }
    env = make(config, 4000)
    chosen = [env.get_state()["goal_button"]]
    for _ in range(2):
        assert stay(env)["goal_met"].all()
        chosen.append(env.get_state()["goal_button"])
    for buttons in chosen:
        assert stats.chisquare(torch.bincount(buttons, minlength=4).numpy()).pvalue > UNLIKELY
    for before, after in itertools.pairwise(chosen):
        pairs = torch.bincount(4 * before + after, minlength=16)
        assert stats.chisquare(pairs.numpy()).pvalue > UNLIKELY


def test_the_goal_of_a_button_task_is_where_its_button_is():
    env = make({"robot_base": "car", "task": "button", "buttons_num": 3}, NUM_ENVS)
    state = env.get_state()
    buttons = torch.stack([places(env, state)[f"button{i}"] for i in range(3)], 1)
    rows = torch.arange(NUM_ENVS)
    assert torch.equal(state["goal_pos"][:, :2], buttons[rows, state["goal_button"]])
    state["goal_button"] = (state["goal_button"] + 1) % 3
    env.set_state(state)
    assert torch.equal(env.get_state()["goal_pos"][:, :2], buttons[rows, state["goal_button"]])


# A goal that is pinned to where the robot stands has no second place.
NO_PLACE = {"robot_base": "point", "frameskip_binom_p": 0.0, "goal_locations": [[1, 1]]}


def at_the_goal(env: SafetyGymEnv) -> TensorDict:
    state = env.get_state()
    state["qpos"][0, :2] = torch.tensor([1.0, 1.0])
    return state


@pytest.mark.parametrize(("continues", "end"), [(True, "truncated"), (False, "terminated")])
def test_episodes_end_where_no_new_goal_fits_and_where_none_is_wanted(continues, end):
    env = make({**NO_PLACE, "continue_goal": continues}, num_envs=3)
    got = stay(env, at_the_goal(env))
    for key in ("goal_met", "done", "reward", end):
        assert got[key][:, 0].tolist() == [True, False, False], key
    (other,) = {"truncated", "terminated"} - {end}
    assert not got[other].any()


def test_or_it_is_an_error_that_says_what_to_change():
    env = make({**NO_PLACE, "terminate_resample_failure": False}, num_envs=3)
    with pytest.raises(LayoutError, match="terminate_resample_failure"):
        stay(env, at_the_goal(env))
