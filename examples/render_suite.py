"""Draw the benchmark's environments, and how layouts differ, into `docs/`.

`python examples/render_suite.py` writes two pictures: `suite.png`, one environment per tile with
the tasks in lines and robots and levels in columns, and `layouts.png`, starts of PointPush2.
"""

import argparse
from pathlib import Path

import mujoco
import numpy as np
from PIL import Image

from safe_rl.envs import SUITE, SafetyGymEnv

ROBOTS, TASKS, LEVELS = ("Point", "Car", "Doggo"), ("Goal", "Button", "Push"), (0, 1, 2)
GAP = 2  # white pixels between tiles


def camera_for(half_extent: float) -> mujoco.MjvCamera:
    """A camera that has a square floor in view, from the south and above [m]."""
    camera = mujoco.MjvCamera()
    camera.lookat[:] = [0, 0, 0.15]
    camera.distance = 2.6 * half_extent + 0.6
    camera.elevation = -52
    return camera


def starts(name: str, num_rows: int, seed: int, width: int, height: int) -> np.ndarray:
    """Frames of starting states, uint8 [num_rows, height, width, 3]."""
    config = SUITE[name].replace(floor_display_mode=True)
    env = SafetyGymEnv(config, num_envs=num_rows, seed=seed)
    env.reset()
    camera = camera_for(config.placements_extents[2])
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


def main() -> None:
    """Draw both pictures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path, default=Path(__file__).parents[1] / "docs")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    for name, draw in (("suite.png", draw_suite), ("layouts.png", draw_layouts)):
        path = options.folder / name
        draw(options.seed).save(path, optimize=True)
        print(f"{path}: {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
