"""Pictures: everything stands where the state says, in its colour, under the right halos."""

import ctypes.util
import math

import mujoco
import numpy as np
import pytest
import torch
from commands import in_a_process
from pictures import colour_at, from_above, likeness, make_env, needs_opengl, redness

import safe_rl.envs
from safe_rl.envs import OpenGLError
from safe_rl.envs.safety_gym.config import ROBOTS
from safe_rl.envs.velocity import VELOCITY_SUITE, VelocityEnv

# One object of every kind, where it stands, and the colour that the benchmark gives it.
KINDS = {
    "box": ((1.5, 0.0), (1, 1, 0)),
    "button": ((-0.3, 1.5), (1, 0.5, 0)),
    "goal": ((1.0, 1.1), (0, 1, 0)),
    "vase": ((-1.4, 0.6), (0, 1, 1)),
    "hazard": ((-1.4, -0.6), (0, 0, 1)),
    "pillar": ((-0.3, -1.5), (0.5, 0.5, 1)),
    "gremlin": ((1.0, -1.1), (0.5, 0, 1)),
}


@pytest.fixture(scope="module")
def everything():
    config = {"task": "push"}
    for kind, (place, _) in KINDS.items():
        name = kind if kind in ("box", "goal") else f"{kind}s"
        config |= {f"{name}_locations": [place]} | ({} if name == kind else {f"{name}_num": 1})
    return make_env(config)


@needs_opengl
@pytest.mark.parametrize("kind", KINDS)
def test_an_object_is_seen_where_it_stands_in_its_colour(everything, kind):
    (x, y), rgb = KINDS[kind]
    assert likeness(colour_at(everything, x, y), rgb) > 0.95
    assert np.ptp(colour_at(everything, x / 2, y / 2)) < 0.02  # the floor before it


# What files of robots often have, too.
ASSETS = """
  <asset>
    <texture name="sky" type="skybox" builtin="flat" rgb1="1 0 0" width="8" height="8"/>
    <texture name="floor" type="2d" builtin="flat" rgb1="1 0 0" width="8" height="8"/>
    <material name="floor" texture="floor"/>
  </asset>
  <worldbody>"""
TRACK = (
    '<camera name="track" mode="trackcom" pos="0 0 3" xyaxes="1 0 0 0 1 0"/><camera name="vision"'
)


@needs_opengl
def test_a_robots_own_names_do_not_clash_with_those_of_pictures(tmp_path):
    path = tmp_path / "robot.xml"
    text = ROBOTS["point"].read_text()
    path.write_text(text.replace("<worldbody>", ASSETS).replace('<camera name="vision"', TRACK))
    (x, y), green = KINDS["goal"]
    observed = {"observe_sensors": False, "observe_goal_lidar": True}
    env = make_env(
        {"task": "goal", "goal_locations": [(x, y)], **observed, "robot_base": str(path)}
    )
    assert np.ptp(colour_at(env, -x, y)) < 0.02
    seen = env.render(0, camera="track", width=101, height=101)  # straight down, x to the right
    height = 101 / (2 * 3.1 * math.tan(math.radians(45 / 2)))  # pixels per metre
    line, column = round(50 - y * height), round(50 + x * height)
    assert likeness(seen[line, column] / 255, green) > 0.95
    with pytest.raises(ValueError, match=r"\['fixednear', 'fixedfar', 'track', 'vision', 'free'\]"):
        env.render(0, camera="eye")
    with pytest.raises(ValueError, match="Did you mean 'fixedfar'"):
        env.render(0, camera="fixdfar")
    with pytest.raises(ValueError, match="at least one pixel, got 480 x 0"):
        env.render(0, height=0)


@needs_opengl
@pytest.mark.parametrize("name", ["CarPush2", "SafeAntVelocity"])
def test_drawing_changes_nothing(name):
    states = []
    for draw in (True, False):
        env = safe_rl.envs.make_env(name, num_envs=2, seed=0)
        tensordict = env.reset()
        for _ in range(3):
            tensordict["action"] = torch.ones(env.action_spec.shape)
            tensordict = env.step_mdp(env.step(tensordict))
            if draw:
                env.render(width=20, height=20)
        states.append(env.get_state())
    assert (states[0] == states[1]).all()


@needs_opengl
@pytest.mark.parametrize("lidar_type", ["pseudo", "natural"])
@pytest.mark.parametrize(("bearing", "yaw"), [(0.2, 0.0), (1.9, 2.5)])
def test_halos_are_lit_towards_the_object(bearing, yaw, lidar_type):
    pillar = (1.5 * math.cos(bearing), 1.5 * math.sin(bearing))
    config = {"pillars_num": 1, "pillars_locations": [pillar], "observe_pillars": True}
    config |= {"robot_rot": yaw, "lidar_type": lidar_type, "lidar_num_bins": 32}
    view = {"camera": from_above(0.0, 0.0, 1.6), "width": 200, "height": 200}
    with_halo = make_env(config).render(0, **view).astype(float)
    without = make_env(config, render_lidar_markers=False).render(0, **view).astype(float)
    # Unlit bins are grey and lit ones blue: the halo adds as much red as blue where it is unlit.
    blue = (with_halo - without)[..., 2] - (with_halo - without)[..., 0]
    weight = blue * (blue > 20)
    assert weight.sum() > 0
    y, x = np.mgrid[99.5:-100:-1, -99.5:100]
    seen = math.atan2((weight * y).sum(), (weight * x).sum())
    assert abs(math.remainder(seen - bearing, 2 * math.pi)) < math.radians(10)


@needs_opengl
def test_a_red_sphere_is_shown_while_a_cost_is_incurred():
    hazard = {"hazards_num": 1, "hazards_locations": [(1.0, 0.0)], "hazards_size": 1.5}
    env = make_env({**hazard, "constrain_hazards": True})
    beside = (-0.17, 0.0)
    assert redness(colour_at(env, *beside)) < 0.1
    assert env.step(env.full_action_spec.zero())["next", "cost"].item() == 1
    assert redness(colour_at(env, *beside)) > 0.2
    env.reset()
    assert redness(colour_at(env, *beside)) < 0.1


def is_skin(frame):
    """Where the robots' brown is."""
    red, _, blue = (frame[..., part].astype(int) for part in range(3))
    return red - blue > 25


@needs_opengl
@pytest.mark.parametrize(
    ("name", "camera"), [*((name, "track") for name in VELOCITY_SUITE), ("SafeAntVelocity", "free")]
)
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


@pytest.mark.parametrize(("backend", "package"), [("egl", "libegl1"), ("osmesa", "libosmesa6")])
def test_a_missing_library_is_an_error_that_names_its_package(monkeypatch, backend, package):
    def fail(*_):
        raise ImportError("no such library")

    monkeypatch.setenv("MUJOCO_GL", backend)
    monkeypatch.setattr(mujoco, "Renderer", fail)
    with pytest.raises(OpenGLError, match=rf"MUJOCO_GL={backend}.*apt-get install.*{package}"):
        make_env({}).render(0)


@needs_opengl
def test_a_picture_that_is_too_large_is_said_to_be():
    env = make_env({})
    with pytest.raises(ValueError, match=r"cannot draw 100000 x 1 pixels.*a smaller picture"):
        env.render(0, width=100_000, height=1)
    assert env.render(0, width=8, height=8).shape == (8, 8, 3)


@pytest.mark.long
@pytest.mark.skipif(bool(ctypes.util.find_library("OSMesa")), reason="OSMesa is installed here")
def test_environments_work_where_opengl_is_missing():
    code = (
        "import os; os.environ.pop('PYOPENGL_PLATFORM', None)  # says what this process uses\n"
        "from safe_rl.envs import SafetyGymEnv; env = SafetyGymEnv('PointGoal1', num_envs=2)\n"
        "print(env.rollout(2).shape); env.render(0)"
    )
    said = in_a_process("-c", code, status=1, MUJOCO_GL="osmesa")
    assert "torch.Size([2, 2])" in said
    assert "apt-get install libosmesa6" in said
