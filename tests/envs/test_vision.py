"""What the robot's camera sees, as part of the observation."""

import gc
import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import mujoco
import pytest
import torch
from pictures import make_env, needs_opengl
from torchrl.envs.utils import check_env_specs

import safe_rl.envs
from safe_rl.collectors import match_columns
from safe_rl.envs import EXTRAS, SUITE, ConfigError, SafetyGymEnv, resolve

VISION = {"observe_vision": True, "observation_flatten": False}
# What the Car sees lies at its negative y axis, what the others see at their positive x axis.
AHEAD = {"point": (1.5, 0.0), "car": (0.0, -1.5), "doggo": (1.5, 0.0)}


def green_columns(picture):
    """Mean column of what is green, from -1 (left) to 1 (right), or None."""
    red, green, blue = picture.unbind(-1)
    columns = (green - torch.maximum(red, blue) > 0.1).nonzero()[:, 1]
    return None if not len(columns) else 2 * columns.double().mean().item() / picture.shape[1] - 1


def sees(robot, goal):
    env = make_env({**VISION, "robot_base": robot, "task": "goal", "goal_locations": [goal]})
    return env.reset()["observation", "vision"][0]


@needs_opengl
@pytest.mark.parametrize("robot", AHEAD)
def test_the_goal_is_seen_where_it_is(robot):
    x, y = AHEAD[robot]
    assert abs(green_columns(sees(robot, (x, y)))) < 0.1
    # a third of a right angle to the left of ahead: (x, y) + half of it turned by 90 degrees
    assert green_columns(sees(robot, (x - y / 2, y + x / 2))) < -0.3
    assert green_columns(sees(robot, (-x, -y))) is None  # behind


@needs_opengl
def test_vision_is_nested_and_flat():
    size = (12, 8)
    nested = make_env({**VISION, "vision_size": size}, num_envs=2)
    flat = make_env({"observe_vision": True, "vision_size": size}, num_envs=2)
    picture = nested.reset()["observation", "vision"]
    assert picture.shape == (2, 8, 12, 3)
    assert picture.dtype == torch.float32
    assert picture.min() >= 0
    assert picture.max() <= 1
    assert list(flat.observation_layout) == sorted(flat.observation_layout)
    columns = flat.observation_layout["vision"]
    torch.testing.assert_close(flat.reset()["observation"][:, columns], picture.flatten(1))
    check_env_specs(nested)
    check_env_specs(flat)


def test_a_robot_without_a_camera_is_an_error(tmp_path):
    folder = Path(safe_rl.envs.__file__).parent / "safety_gym" / "robots"
    text = (folder / "point.xml").read_text().splitlines()
    blind = tmp_path / "blind.xml"
    blind.write_text("\n".join(line for line in text if "<camera" not in line))
    with pytest.raises(ConfigError, match=r"observe_vision.*no camera named 'vision'"):
        SafetyGymEnv({"robot_base": str(blind), "observe_vision": True})
    blind.write_text("\n".join(text).replace('camera name="vision"', 'camera name="eye"'))
    with pytest.raises(ConfigError, match=r"Its cameras are \['eye'\]: rename one of them"):
        SafetyGymEnv({"robot_base": str(blind), "observe_vision": True})


def test_every_environment_has_its_name_and_a_variant_with_vision():
    tasks = [f"{task}{level}" for task in ("Goal", "Button", "Push") for level in "012"]
    tasks += ["Run", "Run1", "Circle", "Circle1", "Circle2"]
    known = [robot + task for robot in ("Point", "Car", "Doggo") for task in tasks]
    assert sorted([*SUITE, *EXTRAS]) == sorted([*known, *(f"{name}Vision" for name in known)])
    for name in known:
        config = resolve(f"Safexp-{name}Vision-v0")
        assert config == resolve(name).replace(observe_vision=True, observation_flatten=False)


def seen_at_reset(env):
    env.set_seed(0)
    return env.reset()["observation", "vision"].clone()


@needs_opengl
@pytest.mark.skipif(os.environ.get("MUJOCO_GL") != "egl", reason="other backends keep to a thread")
def test_pictures_are_the_same_in_all_threads_and_after_the_end_of_other_environments():
    first, later = (make_env({**VISION, "vision_size": (12, 8)}) for _ in range(2))
    expected, made = seen_at_reset(first), []

    def draw():
        made.append(make_env({**VISION, "vision_size": (12, 8)}))
        assert torch.equal(seen_at_reset(first), expected)

    with ThreadPoolExecutor(1) as pool:
        pool.submit(draw).result()
    assert torch.equal(seen_at_reset(made[0]), expected)
    assert torch.equal(seen_at_reset(later), expected)
    made.clear()
    gc.collect()
    assert torch.equal(seen_at_reset(later), expected)


@needs_opengl
def test_closing_frees_what_the_camera_has_opened(monkeypatch):
    closed = []
    close = mujoco.Renderer.close
    monkeypatch.setattr(mujoco.Renderer, "close", lambda self: (closed.append(self), close(self)))
    env = make_env({**VISION, "vision_size": (12, 8)})
    assert not closed
    env.close()
    assert [(renderer.width, renderer.height) for renderer in closed] == [(12, 8)]
    closed.clear()


def test_columns_of_a_turned_picture_are_others():
    upright, turned = (
        safe_rl.envs.make_env("PointGoal1Vision", vision_size=size).interface
        for size in ((4, 6), (6, 4))
    )
    assert upright["columns"] == turned["columns"]
    assert upright["sensors"]["vision_size"] == [4, 6]
    with pytest.raises(ValueError, match=r"their vision_size is \[4, 6\].*environment \[6, 4\]"):
        match_columns(*(x for key in ("columns", "sensors") for x in (upright[key], turned[key])))
