"""One step from every recorded state of the 2019 environments, all rows as parallel worlds.

Physics in contact is chaotic: a rounding error of 1e-16 in a state moves the next one by up to 0.1
where boxes and pillars collide. So rows agree to rounding, or nearly so in hard contact.
"""

import numpy as np
import pytest
import torch
from golden import NAMES, load
from tensordict import TensorDict

from safe_rl.envs import SafetyGymEnv

STATE = ("qpos", "qvel", "qacc_warmstart", "time", "goal_pos", "goal_button", "buttons_timer")
ROUNDING = 1e-12
HARD_CONTACT = 5e-4
# Largest share of rows that may leave the recorded path, in cases where any does: boxes and vases
# against pillars. Measured: 0.28, 0.18, 0.09, 0.48. Other processors round otherwise.
CHAOTIC = {
    "car_push": 0.35,
    "doggo_goal_pillars_raw": 0.25,
    "point_everything": 0.15,
    "point_push": 0.6,
}
# What feels contact forces follows the solver, which stops at a finite accuracy.
FORCE_SENSORS = ("accelerometer", "touch_")


def states(golden, env, rows):
    state = {key: torch.from_numpy(golden[key][rows]) for key in STATE}
    num_rows = rows.stop - rows.start
    state["step_count"] = torch.arange(rows.start, rows.stop)
    names = ("robot", *env.object_names)
    positions = [golden.layout.get(name, [0.0, 0.0]) for name in names]
    state["layout"] = torch.tensor(positions, dtype=torch.float64).expand(num_rows, -1, -1)
    controls = np.concatenate([np.zeros_like(golden["action"][:1]), golden["action"]])
    state["ctrl"] = torch.from_numpy(controls[rows]).clamp(-1, 1)
    return TensorDict(state, batch_size=[num_rows])


@pytest.fixture(params=NAMES, scope="module")
def golden(request):
    return load(request.param)


@pytest.fixture(scope="module")
def env(golden):
    env = SafetyGymEnv(golden.config, num_envs=len(golden["action"]), seed=0, sleep=False)
    env.reset()
    return env


@pytest.fixture(scope="module")
def stepped(golden, env):
    """What one step from every row returns, with the state after it."""
    tensordict = env.set_state(states(golden, env, slice(0, len(golden["action"]))))
    tensordict["action"] = torch.from_numpy(golden["action"])
    return env.step(tensordict)["next"], env.get_state()


def tolerance(name):
    return 1e-2 if name.startswith(FORCE_SENSORS) else 1e-6


def assert_components(golden, observation, keep=None, tolerance=tolerance, rtol=1e-6):
    """Compare rows with those that were recorded, of every component those of `keep(name)`."""
    for name, columns in golden.components.items():
        rows = slice(None) if keep is None else keep(name)
        np.testing.assert_allclose(
            observation[rows, columns],
            golden["observation"][1:][rows, columns],
            rtol=rtol,
            atol=tolerance(name),
            err_msg=name,
        )


def position_error(golden, state):
    return np.abs(state["qpos"].numpy() - golden["qpos"][1:]).max(1)


def test_next_positions(golden, stepped):
    error = position_error(golden, stepped[1])
    assert (error > ROUNDING).mean() <= CHAOTIC.get(golden.name, 0.0)
    assert error.max() <= HARD_CONTACT


def test_rewards_and_ends(golden, stepped):
    result, state = stepped
    soft = position_error(golden, state) <= ROUNDING
    error = np.abs(result["reward"].numpy()[:, 0] - golden["reward"])
    assert error[soft].max() <= 1e-6
    assert error.max() <= HARD_CONTACT
    for key in ("goal_met", "done"):
        np.testing.assert_array_equal(result[key].numpy()[:, 0], golden[key].astype(bool))
    np.testing.assert_array_equal(state["buttons_timer"].numpy(), golden["buttons_timer"][1:])


def test_costs(golden, stepped):
    keys = [key for key in golden.arrays if key.startswith("cost")]
    assert keys
    for key in keys:
        np.testing.assert_allclose(stepped[0][key].numpy()[:, 0], golden[key], atol=1e-6)


def test_observations_after_a_step(golden, stepped, env):
    result, state = stepped
    assert env.observation_layout == golden.components
    # The new goal was drawn at random in both.
    met = golden["goal_met"].astype(bool)
    soft = position_error(golden, state) <= ROUNDING
    assert_components(
        golden,
        result["observation"].numpy(),
        lambda name: soft & ~met if name.startswith("goal_") else soft,
    )


def test_observations_of_a_state(golden, env):
    """Every row's observation, new goals included, follows from its state alone."""
    num_rows = len(golden["action"])
    observation = env.set_state(states(golden, env, slice(1, num_rows + 1)))["observation"].numpy()
    assert_components(golden, observation)
