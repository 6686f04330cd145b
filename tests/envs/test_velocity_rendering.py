"""Pictures of the velocity family: the robot is in them, and too fast ones under a red sphere."""

import numpy as np
import pytest
from pictures import needs_opengl

from safe_rl.envs.velocity import VELOCITY_SUITE, VelocityEnv

pytestmark = needs_opengl


def is_skin(frame):
    """Where the robots' brown is."""
    red, _, blue = (frame[..., part].astype(int) for part in range(3))
    return (red - blue > 25) & ~is_red(frame)


def is_red(frame):
    """Where the sphere is: much more red than anything else."""
    red, green, blue = (frame[..., part].astype(int) for part in range(3))
    return red - np.maximum(green, blue) > 60


@pytest.mark.parametrize("name", VELOCITY_SUITE)
@pytest.mark.parametrize("camera", ["track", "free"])
def test_cameras_move_with_the_robot(name, camera):
    env = VelocityEnv(name, seed=0, num_threads=1)
    env.reset()
    state = env.get_state()
    frames = []
    for distance in (0.0, 3.0):
        state["qpos"][:, 0] = distance
        env.set_state(state)
        frames.append(env.render(0, camera=camera, width=128, height=96))
    near, far = frames
    assert near.shape == (96, 128, 3)
    assert near.dtype == np.uint8
    assert not np.array_equal(near, far)  # the floor has moved
    seen = [is_skin(frame).sum() for frame in frames]
    assert min(seen) > 50
    assert min(seen) > 0.8 * max(seen)
    lines, columns = is_skin(far).nonzero()
    assert 32 < columns.mean() < 96
    assert 24 < lines.mean() < 80


def test_too_fast_robots_are_marked():
    env = VelocityEnv(
        {"robot": "half_cheetah", "velocity_threshold": 1.0}, num_envs=3, seed=0, num_threads=1
    )
    env.reset()
    state = env.get_state()
    state["qvel"][:] = 0.0
    state["qvel"][1, 0] = 5.0
    env.set_state(state)
    written = env.step(env.full_action_spec.zero())["next"]
    assert written["cost"][:, 0].tolist() == [0.0, 1.0, 0.0]
    frames = env.render(width=64, height=48)
    assert frames.shape == (3, 48, 64, 3)
    marked = [is_red(frame).sum() for frame in frames]
    assert marked[1] > 50
    assert max(marked[0], marked[2]) < 5
    env.reset()
    assert is_red(env.render(1, width=64, height=48)).sum() < 5
