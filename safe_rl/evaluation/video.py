"""An episode as an MP4 that browsers play."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from safe_rl.evaluation.episodes import exploration
from safe_rl.extras import import_extra

__all__ = ["record_episode", "write_video"]

WIDTH, HEIGHT = 640, 480
"""Of the picture in pixels."""
STEPS_PER_FRAME = 2
FRAMES_PER_SECOND = 25
"""With ``STEPS_PER_FRAME``, an episode of 1000 steps lasts 20 s: Point's own time."""
_CAPTION_HEIGHT = 20


@torch.no_grad()
def record_episode(
    env: EnvBase, policy: TensorDictModuleBase, *, deterministic: bool, camera: str = "free"
) -> Iterator[np.ndarray]:
    """Run one episode and yield its frames, uint8 [height, width, 3].

    Args:
        env: Environment with one world and ``render``, which draws lidar halos and costs.
        policy: What acts.
        deterministic: Whether it acts with its mean.
        camera: A name that ``env.render`` knows.
    """
    state = env.reset()
    total = {"reward": 0.0, "cost": 0.0}
    step = 0
    with exploration(deterministic):
        while True:
            if step % STEPS_PER_FRAME == 0:
                picture = env.render(rows=0, camera=camera, width=WIDTH, height=HEIGHT)
                yield _with_caption(picture, step, total["reward"], total["cost"])
            after = env.step(policy(state))["next"]
            step += 1
            total = {key: value + float(after[key]) for key, value in total.items()}
            if after["done"].any():
                return
            state = after.exclude("reward")


def _with_caption(picture: np.ndarray, step: int, episode_return: float, cost: float) -> np.ndarray:
    """The picture above a line with what the episode has come to."""
    canvas = Image.new("RGB", (WIDTH, HEIGHT + _CAPTION_HEIGHT), "white")
    canvas.paste(Image.fromarray(picture))
    text = f"step {step:>5}     return {episode_return:>7.2f}     cost {cost:>5.0f}"
    font = ImageFont.load_default(size=14)
    ImageDraw.Draw(canvas).text((8, HEIGHT + 1), text, fill="black", font=font)
    return np.asarray(canvas)


def write_video(path: Path, frames: Iterator[np.ndarray]) -> None:
    """Encode frames as H.264 in an MP4, replaced in one go.

    Raises:
        ModuleNotFoundError: If the encoder is missing; the message names the extra.
    """
    import_extra("imageio_ffmpeg", "video")
    imageio = import_extra("imageio.v2", "video")
    unfinished = path.with_suffix(".tmp.mp4")
    # pixel format and index at the front: what browsers ask of a video
    with imageio.get_writer(
        unfinished,
        format="FFMPEG",
        fps=FRAMES_PER_SECOND,
        codec="libx264",
        pixelformat="yuv420p",
        macro_block_size=4,
        output_params=["-crf", "26", "-preset", "veryfast", "-movflags", "+faststart"],
        ffmpeg_log_level="error",
    ) as writer:
        for frame in frames:
            writer.append_data(frame)
    unfinished.replace(path)
