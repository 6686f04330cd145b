"""The golden transitions on MuJoCo Warp, in float32: one step from every recorded state."""

from importlib.util import find_spec

import numpy as np
import pytest
import torch
from golden import NAMES, load
from test_golden import assert_components, states

from safe_rl.envs import SafetyGymEnv

pytestmark = pytest.mark.skipif(not find_spec("mujoco_warp"), reason="comes with the extra gpu")

QUICK = ("point_goal_hazards", "doggo_z")
NEAR, FAR = 1e-5, 1e-3  # m or rad
# Largest share of rows that end further than FAR away. Measured: 0.28, and at most 0.08 elsewhere:
# boxes and vases in contact. MuJoCo itself leaves the recorded path in 0.28 of the rows of
# car_push, see test_golden.
SWITCHES = {"car_push": 0.35}
# Rates change quickly in contact; an accelerometer feels the solver's forces and is left out.
RATES = ("gyro", "velocimeter", "jointvel_", "ballangvel", "qvel", "touch_")


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.long if name in QUICK else pytest.mark.slow)
        for name in NAMES
        if not name.endswith("natural_lidar")  # which Warp does not have
    ],
)
def test_a_step_from_every_recorded_state(name):
    golden = load(name)
    num_rows = len(golden["action"])
    env = SafetyGymEnv(golden.config | {"physics": "warp"}, num_rows, seed=0)
    env.reset()
    start = env.set_state(states(golden, env, slice(0, num_rows)))
    following = env.step(start.set("action", torch.from_numpy(golden["action"])))["next"]
    apart = np.abs(env.get_state()["qpos"].double().numpy() - golden["qpos"][1:]).max(1)
    assert np.median(apart) <= 3 * NEAR
    assert (apart > FAR).mean() <= SWITCHES.get(name, 0.1)
    near = apart <= NEAR
    assert near.mean() >= 0.4
    met = golden["goal_met"].astype(bool)
    for key in ("goal_met", "done"):
        np.testing.assert_array_equal(following[key].numpy()[:, 0], golden[key].astype(bool))
    for key in ["reward", *(key for key in golden.arrays if key.startswith("cost"))]:
        got = following[key].numpy()[near, 0]
        np.testing.assert_allclose(got, golden[key][near], atol=1e-3, err_msg=key)

    def keep(part):
        kept = near & ~met if part.startswith("goal_") else near
        return kept & (part != "accelerometer")

    tolerance = lambda name: 2e-2 if name.startswith(RATES) else 1e-3  # noqa: E731
    assert_components(golden, following["observation"].numpy(), keep, tolerance, rtol=1e-3)
