"""Looking at pictures: what colour is where, and whether anything can be drawn at all."""

import mujoco
import numpy as np
import pytest

from safe_rl.envs import OpenGLError, SafetyGymEnv


def _missing_opengl():
    try:
        SafetyGymEnv("PointGoal0", seed=0).render(0, width=8, height=8)
    except OpenGLError as error:
        return str(error)
    return ""


MISSING_OPENGL = _missing_opengl()
needs_opengl = pytest.mark.skipif(bool(MISSING_OPENGL), reason=MISSING_OPENGL)

# A robot at the origin that looks along x, and nothing else.
ALONE = {"robot_base": "point", "robot_locations": [(0.0, 0.0)], "robot_rot": 0.0, "task": "none"}


def make_env(config, num_envs=1, **changes):
    env = SafetyGymEnv({**ALONE, **config, **changes}, num_envs=num_envs, seed=0)
    env.reset()
    return env


def from_above(x, y, distance):
    """A camera straight above a place; x points to the right of its pictures, y upwards."""
    camera = mujoco.MjvCamera()
    camera.lookat[:] = [x, y, 0.0]
    camera.distance, camera.azimuth, camera.elevation = distance, 90, -90
    return camera


def colour_at(env, x, y, distance=3.0, row=0):
    """Colour of what one sees of a place from above, over some 7 cm: RGB in [0, 1]."""
    frame = env.render(row, camera=from_above(x, y, distance), width=101, height=101)
    return frame[49:52, 49:52].reshape(-1, 3).mean(0) / 255


def likeness(colour, rgb):
    """Cosine between two colours, without what both have in common with grey."""
    a, b = (np.asarray(c, dtype=float) - np.mean(c) for c in (colour, rgb))
    return a @ b / (np.linalg.norm(a) * np.linalg.norm(b))


def redness(colour):
    """How much more red than anything else, of one colour or of every pixel of a frame."""
    return colour[..., 0] - np.maximum(colour[..., 1], colour[..., 2])
