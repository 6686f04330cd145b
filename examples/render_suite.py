"""Draw environments into `docs/`.

`python examples/render_suite.py` writes three kinds of pictures: `suite.png` with all environments
of the suite (a line per task, columns for robots and levels), `layouts.png` with starts of
PointPush2, and in `environments/pictures/` a small picture of every family of environments. To draw
only some of them, name them as arguments.
"""

import argparse
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
from PIL import Image

from safe_rl.envs import SafetyGymEnv, make_env, resolve
from safe_rl.envs.velocity import VELOCITY_SUITE

ROBOTS, TASKS, LEVELS = ("Point", "Car", "Doggo"), ("Goal", "Button", "Push"), (0, 1, 2)
GAP = 2  # white pixels between tiles
SIZE, COLOURS = (240, 160), 128  # of a family's picture; few colours make small files


def camera_for(half_extent: float) -> mujoco.MjvCamera:
    """A camera that has a square floor in view, from the south and above [m]."""
    camera = mujoco.MjvCamera()
    camera.lookat[:] = [0, 0, 0.15]
    camera.distance = 2.6 * half_extent + 0.6
    camera.elevation = -52
    return camera


def starts(
    name: str, num_rows: int, seed: int, width: int, height: int, nearness: float = 1.0
) -> np.ndarray:
    """Frames of starting states, uint8 [num_rows, height, width, 3]."""
    config = resolve(name).replace(floor_display_mode=True)
    env = SafetyGymEnv(config, num_envs=num_rows, seed=seed)
    env.reset()
    camera = camera_for(config.placements_extents[2])
    camera.distance /= nearness
    frames = env.render(camera=camera, width=width, height=height)
    env.close()
    return frames


def grid(frames: np.ndarray) -> Image.Image:
    """Lay frames [lines, columns, H, W, 3] out with gaps between them."""
    lines, columns, height, width, _ = frames.shape
    picture = np.full(
        (lines * (height + GAP) - GAP, columns * (width + GAP) - GAP, 3), 255, dtype=np.uint8
    )
    for line in range(lines):
        for column in range(columns):
            top, left = line * (height + GAP), column * (width + GAP)
            picture[top : top + height, left : left + width] = frames[line, column]
    return Image.fromarray(picture)


def draw_suite(seed: int) -> Image.Image:
    """All 27 environments: a line per task; per robot, a column per level."""
    frames = [
        [
            starts(f"{robot}{task}{level}", 1, seed + shift, 230, 190)[0]
            for shift, robot in enumerate(ROBOTS)  # another layout for every robot
            for level in LEVELS
        ]
        for task in TASKS
    ]
    return grid(np.array(frames))


def draw_layouts(seed: int) -> Image.Image:
    """Ten starts of PointPush2."""
    frames = starts("PointPush2", 10, seed, 300, 240)
    return grid(frames.reshape(2, 5, *frames.shape[1:]))


def draw_safety_gym(seed: int) -> Image.Image:
    """A start of CarPush2, from nearer, so that it fills the wide picture."""
    return Image.fromarray(starts("CarPush2", 1, seed, *SIZE, nearness=1.25)[0])


def draw_circle(seed: int) -> Image.Image:
    """A start within boundaries."""
    return Image.fromarray(starts("PointCircle2", 1, seed, *SIZE)[0])


def draw_vision(seed: int) -> Image.Image:
    """The image of the robot's camera with the most detail, out of twelve starts."""
    config = resolve("PointGoal1Vision").replace(vision_size=SIZE)
    seen = SafetyGymEnv(config, num_envs=12, seed=seed).reset()["observation", "vision"]
    pictures = [Image.fromarray(picture) for picture in (seen * 255).byte().numpy()]
    return max(pictures, key=lambda picture: picture.entropy())


def draw_velocity(seed: int) -> Image.Image:
    """The six robots of the velocity family."""
    side = SIZE[1]  # the grid is made smaller at the end
    frames = []
    for name in VELOCITY_SUITE:
        env = make_env(name, num_envs=1, seed=seed)
        env.reset()
        frames.append(env.render(0, width=side, height=side))
    return grid(np.array(frames).reshape(2, 3, side, side, 3)).resize(SIZE)


def draw_gymnasium(seed: int) -> Image.Image:
    """Gymnasium's cart with a pole."""
    width, height = SIZE
    size = {"width": width, "height": height}
    node = {"id": "InvertedPendulum-v5", "kwargs": size, "render_mode": "rgb_array"}
    node |= {"outside": {"cost_place": [0, -1, 1]}}
    env = make_env({"_target_": "safe_rl.envs.gymnasium.make_gymnasium", **node}, seed=seed)
    env.reset()
    return Image.fromarray(env.render(0, **size))


def draw_torchrl(seed: int) -> Image.Image:
    """TorchRL's humanoid: the middle part of a larger picture."""
    width, height = SIZE
    size = {"from_pixels": True, "render_width": 2 * width, "render_height": 2 * height}
    node = {"id": "HumanoidEnv", "kwargs": size, "observe": ["pixels"], "num_steps": 100}
    node |= {"outside": {"cost_height": ["observation", 0, 1, 2]}}
    env = make_env({"_target_": "safe_rl.envs.torchrl.make_torchrl", **node}, seed=seed)
    picture = Image.fromarray(env.reset()["observation"][0].numpy())
    return picture.crop((width // 2, height // 2, width * 3 // 2, height * 3 // 2))


FAMILIES: dict[str, Callable[[int], Image.Image]] = {
    "safety_gym": draw_safety_gym,
    "circle": draw_circle,
    "vision": draw_vision,
    "velocity": draw_velocity,
    "gymnasium": draw_gymnasium,
    "torchrl": draw_torchrl,
}
PICTURES = {
    "suite.png": draw_suite,
    "layouts.png": draw_layouts,
    **{f"environments/pictures/{name}.png": draw for name, draw in FAMILIES.items()},
}


def main() -> None:
    """Draw the pictures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("pictures", nargs="*", help=f"by default all: {', '.join(PICTURES)}")
    parser.add_argument("--folder", type=Path, default=Path(__file__).parents[1] / "docs")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    if unknown := set(options.pictures) - set(PICTURES):
        parser.error(f"no picture is called {', '.join(unknown)}: choose {', '.join(PICTURES)}")
    for name in options.pictures or PICTURES:
        path = options.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        picture = PICTURES[name](options.seed)
        if picture.size == SIZE:
            picture = picture.quantize(COLOURS)
        picture.save(path, optimize=True)
        print(f"{path}: {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
