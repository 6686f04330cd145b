"""An episode as an MP4 that browsers play."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from inspect import signature
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont
from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from safe_rl.evaluation.episodes import exploration
from safe_rl.extras import import_extra
from safe_rl.runs.files import replacing

__all__ = ["check_camera", "record_episode", "write_video"]

WIDTH, HEIGHT = 640, 480
"""Of the picture in pixels, where the environment lets it be chosen."""
STEPS_PER_FRAME = 2
FRAMES_PER_SECOND = 25
"""With ``STEPS_PER_FRAME``, an episode of 1000 steps lasts 20 s: Point's own time."""
DEFAULT_CAMERA = "free"
_CAPTION_HEIGHT = 20


def check_camera(env: EnvBase, camera: str) -> None:
    """Draw a picture, to notice before any episode what would prevent a video.

    Raises:
        ValueError: If the environment draws no pictures, or has no such camera.
        ModuleNotFoundError: If the encoder is missing; the message names the extra.
    """
    import_extra("imageio_ffmpeg", "video")
    if not callable(getattr(env, "render", None)):
        raise ValueError("video=true: this environment draws no pictures, it has no 'render'.")
    if camera != DEFAULT_CAMERA and "camera" not in _parameters(env):
        raise ValueError(f"camera={camera}: this environment has no cameras to choose from.")
    env.reset()
    _picture(env, camera)


def _parameters(env: EnvBase) -> set[str]:
    return set(signature(env.render).parameters)


def _picture(env: EnvBase, camera: str) -> np.ndarray:
    """World 0 as it is, uint8 [height, width, 3]; sizes and cameras where they can be chosen."""
    wanted: dict[str, Any] = {"rows": 0, "camera": camera, "width": WIDTH, "height": HEIGHT}
    known = _parameters(env)
    picture = np.asarray(env.render(**{k: v for k, v in wanted.items() if k in known}))
    picture = picture[0] if picture.ndim == 4 else picture
    # the encoding halves both sides
    return picture[: picture.shape[0] // 4 * 4, : picture.shape[1] // 4 * 4]


@torch.no_grad()
def record_episode(
    env: EnvBase,
    policy: Callable[[TensorDictBase], TensorDictBase],
    cost_keys: Sequence[str],
    *,
    deterministic: bool,
    camera: str = DEFAULT_CAMERA,
) -> Iterator[np.ndarray]:
    """Run one episode and yield its frames, uint8 [height, width, 3].

    Args:
        env: Environment with one world and ``render``.
        policy: What acts.
        cost_keys: Keys of its costs; the first is counted below the picture.
        deterministic: Whether it acts with its mean.
        camera: A name that ``env.render`` knows.
    """
    state = env.reset()
    total = dict.fromkeys(("reward", *cost_keys[:1]), 0.0)
    step = 0
    with exploration(deterministic):
        while True:
            if step % STEPS_PER_FRAME == 0:
                yield _with_caption(_picture(env, camera), step, *total.values())
            after = env.step(policy(state))["next"]
            step += 1
            total = {key: value + float(after[key]) for key, value in total.items()}
            if after["done"].any():
                return
            state = after.exclude("reward")


def _with_caption(
    picture: np.ndarray, step: int, episode_return: float, cost: float | None = None
) -> np.ndarray:
    """The picture above a line with what the episode has come to."""
    height, width, _ = picture.shape
    canvas = Image.new("RGB", (width, height + _CAPTION_HEIGHT), "white")
    canvas.paste(Image.fromarray(picture))
    text = f"step {step:>5}     return {episode_return:>7.2f}"
    text += "" if cost is None else f"     cost {cost:>5.0f}"
    font = ImageFont.load_default(size=14)
    ImageDraw.Draw(canvas).text((8, height + 1), text, fill="black", font=font)
    return np.asarray(canvas)


def write_video(path: Path, frames: Iterator[np.ndarray]) -> None:
    """Encode frames as H.264 in an MP4, replaced in one go.

    Raises:
        ModuleNotFoundError: If the encoder is missing; the message names the extra.
    """
    import_extra("imageio_ffmpeg", "video")
    imageio = import_extra("imageio.v2", "video")
    # pixel format and index at the front: what browsers ask of a video
    with (
        replacing(path) as unfinished,
        imageio.get_writer(
            unfinished,
            format="FFMPEG",
            fps=FRAMES_PER_SECOND,
            codec="libx264",
            pixelformat="yuv420p",
            macro_block_size=4,
            output_params=["-crf", "26", "-preset", "veryfast", "-movflags", "+faststart"],
            ffmpeg_log_level="error",
        ) as writer,
    ):
        for frame in frames:
            writer.append_data(frame)
