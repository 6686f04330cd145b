"""Videos, animated pictures and recordings of evaluated episodes."""

from unittest.mock import Mock

import numpy as np
import pandas
import pytest
import torch
from evaluated_runs import NUM_STEPS, options, skip_without_opengl
from PIL import Image, ImageSequence

from safe_rl.collectors import read_recording
from safe_rl.envs import from_gymnasium, make_env
from safe_rl.envs.velocity import VelocityEnv
from safe_rl.evaluation import evaluate, measuring, video
from safe_rl.evaluation.video import FORMATS, video_format

pytestmark = pytest.mark.long


@pytest.mark.parametrize(
    ("make", "steps_per_frame", "rate"),
    [
        (lambda: make_env("PointGoal1", seed=0), 2, 25.0),
        (lambda: make_env("CarGoal1", seed=0), 1, 25.0),
        (lambda: make_env("DoggoGoal1", seed=0), 1, 10.0),
        (lambda: VelocityEnv("SafeHopperVelocity", seed=0), 5, 25.0),
        (lambda: VelocityEnv("SafeHalfCheetahVelocity", seed=0), 1, 20.0),
        (lambda: from_gymnasium("Safexp-CarGoal1-v0", num_steps=10, seed=0), 1, 25.0),
    ],
)
def test_a_film_runs_as_fast_as_what_it_shows(make, steps_per_frame, rate):
    """Robots are controlled at different rates; a Doggo would seem to run five times as fast."""
    film = video_format(make(), "mp4")
    assert (film.steps_per_frame, film.frames_per_second) == pytest.approx((steps_per_frame, rate))
    assert video_format(make(), "gif") == FORMATS["gif"]


def test_the_video_shows_an_episode(run):
    imageio = pytest.importorskip("imageio.v2", reason="needs the extra 'video'")
    pytest.importorskip("imageio_ffmpeg", reason="needs the extra 'video'")
    skip_without_opengl()
    film = FORMATS["mp4"]
    result = evaluate(run, options(episodes=1, video=True))
    assert result.files[-1] == run / "evaluation.mp4"
    with imageio.get_reader(run / "evaluation.mp4") as reader:
        facts = reader.get_meta_data()
        frames = np.stack([frame for frame in reader])  # noqa: C416, a list() would ask for its length
    assert facts["codec"] == "h264"
    assert facts["pix_fmt"].startswith("yuv420p")
    assert len(frames) == NUM_STEPS // film.steps_per_frame + 1  # and the end
    assert frames.shape[2] == film.width
    # below the picture stands a white line with black text
    caption = frames[:, film.height + 2 :]
    assert np.median(caption) > 240
    assert caption.min() < 80
    assert np.abs(frames[0, : film.height].astype(float) - frames[-1, : film.height]).max() > 50


def test_what_an_evaluation_records_is_what_it_measured(run):
    """Seven episodes of three worlds, which go on together until the last one is done."""
    result = evaluate(run, options(record=True, name="kept"))
    assert [path.name for path in result.files] == [
        *("evaluation_kept.json", "evaluation_kept.csv", "evaluation_kept.transitions")
    ]
    steps = read_recording(result.files[-1])
    assert steps.shape == (3, 3 * NUM_STEPS)
    returns = steps["next", "reward"].double().reshape(3, 3, NUM_STEPS).sum(-1)
    found = pandas.read_csv(result.files[1])["return"]
    # three of the first world, two of the others
    expected = [*returns[0].tolist(), *returns[1:, :2].flatten().tolist()]
    assert found.tolist() == pytest.approx(expected, abs=1e-5)
    evaluate(run, options(episodes=1, num_envs=1, record=True, name="kept"))
    assert read_recording(result.files[-1]).shape == (1, NUM_STEPS)


@pytest.mark.parametrize("suffix", ["gif", "webp"])
def test_an_animated_picture_shows_the_same_episode(run, tmp_path, suffix):
    skip_without_opengl()
    film, path = FORMATS[suffix], tmp_path / f"episode.{suffix}"
    (tmp_path / "python").symlink_to(run)  # outside of the run's folder links may lie beside it
    other, result = (
        evaluate(run, options(episodes=2, picture=str(path), **extra))
        for extra in ({}, {"camera": "fixedfar"})
    )
    assert result.files[-1] == path
    with Image.open(path) as picture:
        assert picture.info["loop"] == 0
        assert picture.n_frames == -(-NUM_STEPS // film.steps_per_frame) + 1
        shown = ImageSequence.Iterator(picture)
        frames = np.stack([np.asarray(frame.convert("RGB"), dtype=float) for frame in shown])
    assert frames.shape[2] == film.width
    caption = frames[:, film.height + 4 :]
    assert np.median(caption) > 240
    assert caption.min() < 110
    # something moves, and what stands still is the same in all frames
    moved = np.abs(frames[0] - frames[-1])[: film.height].max(-1) > 40
    assert 0.0 < moved.mean() < 0.5
    assert result.estimates["episode_return"] == other.estimates["episode_return"]


@pytest.mark.parametrize("deterministic", [False, True])
def test_of_one_world_it_is_the_first_episode_to_its_end(run, deterministic, tmp_path, monkeypatch):
    skip_without_opengl()
    draw = Mock(wraps=video._frame)

    def drawing(*given, **keys):  # as environments of one's own may, from torch's generator
        torch.rand(3)
        return make_env(*given, **keys)

    monkeypatch.setattr(video, "_frame", draw)
    monkeypatch.setattr(measuring, "maker_of", lambda run: drawing)
    picture = str(tmp_path / "episode.webp")
    changes = {"num_envs": 1, "deterministic": deterministic}
    result = evaluate(run, options(episodes=2, picture=picture, **changes))
    first = pandas.read_csv(result.files[1]).loc[0, ["length", "return", "cost"]]
    assert draw.call_args.args[1:] == pytest.approx(first.tolist(), abs=1e-5)
