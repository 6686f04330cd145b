"""An episode as an MP4 that browsers play, or as an animated picture for pages of text."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from inspect import signature
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont
from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from safe_rl.evaluation.episodes import exploration
from safe_rl.evaluation.settings import PICTURES, EvaluationOptions
from safe_rl.extras import import_extra
from safe_rl.files import replacing
from safe_rl.naming import STEPS_TAKEN


class VideoFormat(NamedTuple):
    """Format in which an episode is recorded."""

    width: int  # [pixels], if the environment lets it be chosen
    height: int
    steps_per_frame: int  # environment steps
    frames_per_second: float  # of playback


FORMATS = {
    # for environments that do not say how long a step lasts; 1000 steps last 20 s
    "mp4": VideoFormat(640, 480, 2, 25),
    # 1000 steps last 10 s for any environment, so that no picture gets too large for a page
    **dict.fromkeys(PICTURES, VideoFormat(400, 300, 5, 20)),
}
"""Suffix of a file -> format in which an episode is recorded."""
_CAPTION = 20  # height of the line below the picture [pixels]
_FRAME = 0.04  # simulated time from one frame of an MP4 to the next [s]


def video_format(env: EnvBase, suffix: str) -> VideoFormat:
    """Format of the recording of an environment's episode, for a suffix in `FORMATS`.

    An MP4 plays in real time, if the environment has ``seconds_per_step``.
    """
    form, seconds, together = FORMATS[suffix], env.seconds_per_step, env.steps_per_decision
    rate = form.steps_per_frame * form.frames_per_second  # steps in a second of the video
    frame = form.steps_per_frame
    if suffix == "mp4" and seconds:
        rate, frame = 1 / seconds, _FRAME / seconds
    steps = max(1, round(frame / together)) * together
    return form._replace(steps_per_frame=steps, frames_per_second=rate / steps)


def check_camera(env: EnvBase, camera: str, suffix: str = "mp4") -> None:
    """Draw a picture, to find out before any episode whether a video can be made.

    Raises:
        ValueError: If the environment has no ``render`` or no such camera, or if its ``render``
            fails for any reason.
        ModuleNotFoundError: If the encoder is missing; the message names the extra.
    """
    if suffix == "mp4":
        for package in ("imageio", "imageio_ffmpeg"):
            import_extra(package, "video")
    asked = "video=true" if suffix == "mp4" else "picture=…"
    if env.render is None:
        raise ValueError(f"{asked}: this environment draws no pictures, it has no 'render'.")
    if camera != EvaluationOptions.camera and "camera" not in signature(env.render).parameters:
        raise ValueError(f"camera={camera}: this environment has no cameras to choose from.")
    env.reset()
    try:
        _picture(env, camera, FORMATS[suffix])
    except Exception as error:  # the 'render' of any library may raise anything
        words = " ".join(str(error).split()) or type(error).__name__
        raise ValueError(f"{asked}: this environment cannot be drawn: {words}") from error


def _picture(env: EnvBase, camera: str, form: VideoFormat) -> Image.Image:
    """Picture of world 0; with this size and camera, if `render` has arguments for them."""
    wanted = {"rows": 0, "camera": camera, "width": form.width, "height": form.height}
    known = signature(env.render).parameters
    pixels = np.asarray(env.render(**{k: v for k, v in wanted.items() if k in known}))
    if pixels.dtype == object:  # None, or a list of None
        raise ValueError(
            "its 'render' draws no picture; one of Gymnasium's may have to be made with "
            "render_mode=rgb_array, here one of env.kwargs"
        )
    # also grey pictures, and those with a fourth channel
    picture = Image.fromarray(pixels[0] if pixels.ndim == 4 else pixels)
    # the encoder needs sides that can be halved
    return picture.crop((0, 0, picture.width // 4 * 4, picture.height // 4 * 4))


@torch.no_grad()
def record_episode(
    env: EnvBase,
    policy: Callable[[TensorDictBase], TensorDictBase],
    *,
    deterministic: bool,
    form: VideoFormat,
    camera: str = EvaluationOptions.camera,
) -> Iterator[np.ndarray]:
    """Run one episode and yield its frames, uint8 [height, width, 3].

    Below each picture are the step, the return and the sum of the first cost so far. The last frame
    shows the final state. The environment must have batch size [1].
    """
    state = env.reset()
    total = dict.fromkeys((env.return_key, env.cost_keys[0]), 0.0)
    step = 0
    with exploration(deterministic):
        while True:
            if step % form.steps_per_frame == 0:
                yield _frame(_picture(env, camera, form), step, *total.values())
            after = env.step(policy(state))["next"]
            step += int(after[STEPS_TAKEN]) if env.steps_per_decision != 1 else 1
            total = {key: value + float(after[key]) for key, value in total.items()}
            if after["done"].any():
                yield _frame(_picture(env, camera, form), step, *total.values())
                return
            state = after.exclude("reward")


def _frame(picture: Image.Image, step: int, episode_return: float, cost: float) -> np.ndarray:
    """The picture above a line with step, return and cost so far, uint8 [height, width, 3]."""
    # at least as wide as the text
    canvas = Image.new("RGB", (max(picture.width, 280), picture.height + _CAPTION), "white")
    canvas.paste(picture)
    text = f"step {step:>5}     return {episode_return:>7.2f}     cost {cost:>5.0f}"
    font = ImageFont.load_default(size=14)
    ImageDraw.Draw(canvas).text((8, picture.height + 1), text, fill="black", font=font)
    return np.asarray(canvas)


def write_video(path: Path, frames: Iterator[np.ndarray], form: VideoFormat) -> None:
    """Encode frames in the format in which they were recorded; the file is replaced in one go.

    Raises:
        ModuleNotFoundError: If the encoder is missing; the message names the extra.
    """
    write = _write_mp4 if path.suffix == ".mp4" else _write_animation
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as unfinished:
        write(unfinished, frames, form.frames_per_second)


def _write_mp4(path: Path, frames: Iterator[np.ndarray], rate: float) -> None:
    # browsers need this pixel format, and the index at the front of the file
    with import_extra("imageio.v2", "video").get_writer(
        path, format="FFMPEG", fps=rate, codec="libx264", pixelformat="yuv420p",
        macro_block_size=4, ffmpeg_log_level="error",
        output_params=["-crf", "26", "-preset", "veryfast", "-movflags", "+faststart"],
    ) as writer:  # fmt: skip
        for frame in frames:
            writer.append_data(frame)


def _write_animation(path: Path, frames: Iterator[np.ndarray], rate: float) -> None:
    pictures = [Image.fromarray(frame) for frame in frames]
    if path.suffix == ".gif":
        # one palette for all frames, and no dither, so that static parts are stored only once
        few = np.concatenate([np.asarray(p) for p in pictures[:: len(pictures) // 8 + 1]])
        palette = Image.fromarray(few).quantize(64)
        pictures = [p.quantize(palette=palette, dither=Image.Dither.NONE) for p in pictures]
    durations = [round(1000 / rate)] * (len(pictures) - 1) + [1500]  # the last one stays [ms]
    pictures[0].save(
        path, save_all=True, append_images=pictures[1:], duration=durations,
        loop=0, optimize=True, quality=60, method=6,
    )  # fmt: skip
