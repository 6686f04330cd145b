"""The evaluate command on a tiny trained run: what it runs, writes and refuses."""

import csv
import functools
import json
import pickle
import shutil
import zipfile
from pathlib import Path

import numpy as np
import pytest
import yaml
from omegaconf import OmegaConf
from PIL import Image
from run_configs import compose_config

from safe_rl.cli.benchmark import suite
from safe_rl.cli.evaluate import evaluate_run as evaluate
from safe_rl.cli.evaluate import main
from safe_rl.collectors import read_recording
from safe_rl.envs import OpenGLError, make_env, store_configs
from safe_rl.evaluation.settings import EvaluationOptions
from safe_rl.evaluation.video import MANNERS
from safe_rl.scores.published import REFERENCE
from safe_rl.training.trainer import build_trainer, seed_everything

NUM_STEPS = 40


def train(directory, *overrides):
    """A run of two epochs on PointGoal1 with short episodes."""
    store_configs()
    config = compose_config(
        "env=PointGoal1",
        f"env.num_steps={NUM_STEPS}",
        "frames=320",
        "num_envs=4",
        "frames_per_batch=160",
        "model.hidden_sizes=[16]",
        "policy_update.minibatch_size=80",
        "critic_update.minibatch_size=80",
        "logger=none",
        *overrides,
    )
    seed_everything(config.seed, num_threads=1)
    node = OmegaConf.to_container(config.env, resolve=True)
    env = make_env(node, num_envs=4, seed=config.seed, num_threads=1)
    build_trainer(config, env, directory).run()
    return directory


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    return train(tmp_path_factory.mktemp("runs") / "run")


@pytest.fixture
def run(trained, tmp_path):
    """A copy to write into."""
    return Path(shutil.copytree(trained, tmp_path / "run"))


def options(**changes):
    return EvaluationOptions(**{"episodes": 7, "num_envs": 3, "num_threads": 1, **changes})


def read_columns(path):
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    return {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}


def test_the_summary_is_that_of_the_episodes(run):
    result = evaluate(run, options(cvar_alpha=0.5))
    assert [path.name for path in result.files] == ["evaluation.json", "evaluation.csv"]
    episodes = read_columns(run / "evaluation.csv")
    assert set(episodes) == {"return", "length", "cost", "cost_hazards", "cost_exception"}
    np.testing.assert_array_equal(episodes["length"], NUM_STEPS)
    assert len(episodes["cost"]) == 7
    assert episodes["return"].std() > 0
    written = json.loads((run / "evaluation.json").read_text())
    values = {name: estimate["value"] for name, estimate in written["estimates"].items()}
    for key in ("return", "length", "cost", "cost_hazards", "cost_exception"):
        assert values[f"episode_{key}"] == pytest.approx(episodes[key].mean())
    worst = np.sort(episodes["cost"])[::-1]
    assert values["cvar_cost"] == pytest.approx((worst[:3].sum() + 0.5 * worst[3]) / 3.5)
    assert values["over_limit_cost"] == pytest.approx((episodes["cost"] > 25).mean())
    # another episode length than the benchmark's: nothing to normalise by
    assert "normalised_return" not in values
    assert written["steps"] == 320
    assert written["layouts_trained_on"] == 0.0
    assert written["seed"] != 0


def test_scores_are_normalised_where_the_environment_is_the_benchmarks(run):
    limits = {"cost_limits": {"cost": 0.0}}
    config = OmegaConf.merge(OmegaConf.load(run / "config.yaml"), limits)
    OmegaConf.save(config, run / "config.yaml")
    found = evaluate(run, options(episodes=6, num_envs=6, env={"num_steps": 1000})).estimates
    reference = REFERENCE["PointGoal1"]
    assert found["normalised_return"].value == pytest.approx(
        found["episode_return"].value / reference.episode_return
    )
    cost = found["episode_cost"].value
    assert cost > 0.0
    assert found["normalised_violation"].value == pytest.approx(cost / reference.episode_cost)


def test_the_seed_decides_and_the_mean_action_is_not_sampled(run):
    def returns(**changes):
        evaluate(run, options(**changes))
        return read_columns(run / "evaluation.csv")["return"].tolist()

    sampled = returns(seed=5)
    assert returns(seed=5) == sampled
    assert returns(seed=6) != sampled
    assert returns(seed=5, deterministic=True) != sampled


def test_layouts_can_be_those_of_training_or_others(run):
    trained_on = {"env": {"layout_seeds": 10, "layout_seeds_first": 0}}
    config = OmegaConf.merge(OmegaConf.load(run / "config.yaml"), trained_on)
    OmegaConf.save(config, run / "config.yaml")

    def known(**env):
        return evaluate(run, options(episodes=1, env=env)).facts["layouts_trained_on"]

    assert known() == 1.0
    assert known(layout_seeds_first=1000) == 0.0
    assert known(layout_seeds=None) == 0.0


def change_config(run, **changes):
    config = yaml.safe_load((run / "config.yaml").read_text())
    (run / "config.yaml").write_text(yaml.safe_dump({**config, **changes}))


def test_an_environment_of_another_kind_has_no_published_scores(run, monkeypatch):
    """What fulfils the contract of environments and calls itself PointGoal1."""
    change_config(run, env={"_target_": "mine.build", "name": "PointGoal1", "cost_keys": ["cost"]})
    make = functools.partial(make_env, "PointGoal1")
    monkeypatch.setattr("safe_rl.envs.make_env", lambda node, **kwargs: make(**kwargs))
    found = evaluate(run, options(episodes=2)).estimates
    assert found["episode_length"].value == 1000
    assert "normalised_return" not in found


def test_a_configuration_may_hold_the_changed_keys_only(run):
    full, defaults = yaml.safe_load((run / "config.yaml").read_text())["env"], suite().defaults
    changed = {key: value for key, value in full.items() if value != defaults[key]}
    assert "randomize_layout" not in changed
    change_config(run, env={**changed, "name": "mine"})
    result = evaluate(run, options(episodes=2))
    assert (result.facts["environment"], result.facts["layouts_trained_on"]) == ("mine", 0.0)


def test_a_foreign_configuration_learns_nothing_of_this_machine(run, capsys, monkeypatch):
    monkeypatch.setenv("SECRET", "hush")
    change_config(run, env={"name": "${oc.env:SECRET}", "robot_base": "point"})
    assert main([str(run), "episodes=1"]) == 1
    shown = capsys.readouterr()
    assert "hush" not in shown.out + shown.err
    assert "without interpolations" in shown.err


def test_what_is_interrupted_leaves_the_evaluation_of_before(run, monkeypatch):
    evaluate(run, options(episodes=1))
    before = {path.name: path.read_bytes() for path in run.glob("evaluation*")}
    written = Path.write_text

    def fail(path, text, *args, **kwargs):
        written(path, text[: len(text) // 2], *args, **kwargs)
        raise OSError("no space left")

    with monkeypatch.context() as patched:
        patched.setattr(Path, "write_text", fail)
        with pytest.raises(OSError, match="no space"):
            evaluate(run, options(episodes=2))
    assert {path.name: path.read_bytes() for path in run.glob("evaluation*")} == before
    assert not list(run.glob(".*unfinished*"))


def test_environments_are_closed_whatever_happens(run, monkeypatch):
    made = []

    def make(node, **kwargs):
        made.append(make_env(node, **kwargs))
        return made[-1]

    monkeypatch.setattr("safe_rl.envs.make_env", make)
    evaluate(run, options(episodes=1))
    monkeypatch.setattr("safe_rl.evaluation.measuring.collect_episodes", None)
    with pytest.raises(TypeError):
        evaluate(run, options(episodes=1))
    assert [env.is_closed for env in made] == [True, True]


def test_evaluations_of_a_name_stand_side_by_side(run):
    evaluate(run, options(episodes=1))
    evaluate(run, options(episodes=2, name="other"))
    numbers = [
        json.loads((run / f"{name}.json").read_text())["episodes"]
        for name in ("evaluation", "evaluation_other")
    ]
    assert numbers == [1, 2]


def test_the_best_checkpoint_is_taken_on_demand(run):
    best = max((run / "checkpoints" / "best").iterdir())
    for named in ("best", str(best)):
        facts = evaluate(run, options(episodes=1, checkpoint=named)).facts
        assert facts["checkpoint_file"] == str(best)
        assert facts["steps"] == int(best.stem.removeprefix("checkpoint-"))


def test_the_command_prints_a_table(run, capsys):
    assert main([str(run), "episodes=3", "num_envs=3", "num_threads=1"]) == 0
    shown = capsys.readouterr().out
    assert shown.startswith("ppo_lagrangian on PointGoal1 at 320 steps: 3 episodes")
    assert "95 % interval" in shown
    line = next(line for line in shown.splitlines() if line.startswith("episode_cost "))
    assert line.endswith("limit 25")
    assert f"wrote {run}/evaluation.json" in shown


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["epsiodes=3"], "Did you mean 'episodes'?"),
        (["env.hazard_num=3"], "hazards_num"),
        (["episodes=0"], "episodes=0"),
        (["checkpoint=there.torchrl"], "checkpoint is last, best, certified or the path"),
        (["env.lidar_num_bins=8"], "trained on other observations"),
        (["cvar_alpha=2"], "cvar_alpha"),
        (["camera=nowhere", "video=true"], "nowhere"),
        (["picture=there.png"], "must end in .gif or .webp"),
        (["picture=nowhere/there.gif"], "there is no folder nowhere"),
        (["certify=true", "env.hazards_num=3"], "env: certify=true does not heed it"),
        (["certificate.episodes=9"], "add certify=true"),
        (["certify=true", "certificate.episode=9"], "Did you mean 'episodes'?"),
        (["env.hazards_num=200", "episodes=1"], "hazards"),
    ],
)
def test_what_cannot_be_done_ends_in_one_line(run, arguments, message, capsys, monkeypatch):
    if "video=true" in arguments:
        skip_without_opengl()
        # before any episode
        monkeypatch.setattr("safe_rl.evaluation.measuring.collect_episodes", None)
    assert main([str(run), *arguments]) == 1
    error = capsys.readouterr().err.splitlines()[-1]
    assert error.startswith("error: ")
    assert message in error


def test_a_dictionary_of_another_size_ends_in_one_line_too(tmp_path, capsys):
    run = train(tmp_path / "run", "env.observation_flatten=false", "model=dict")
    assert main([str(run), "env.lidar_num_bins=8"]) == 1
    error = capsys.readouterr().err.splitlines()[-1]
    assert error.startswith("error: ")
    # as many as the same environment has in one vector
    own = OmegaConf.to_container(OmegaConf.load(run / "config.yaml").env)
    flat = {**own, "observation_flatten": True, "lidar_num_bins": 8}
    size = make_env(flat, num_envs=1, seed=0).observation_spec["observation"].shape[-1]
    assert f"trained on other observations or actions than this environment's ({size} num" in error


@pytest.mark.parametrize(
    ("argument", "others"), [("episodes=0", "num_envs"), ("num_envs=0", "episodes"),
                             ("cvar_alpha=3.0", "episodes="), ("cvar_alpha=nan", "episodes=")]
)  # fmt: skip
def test_options_out_of_range_are_refused_before_anything_runs(
    argument, others, run, capsys, monkeypatch
):
    monkeypatch.setattr("safe_rl.evaluation.measuring.load_config", None)
    assert main([str(run), argument]) == 1
    error = capsys.readouterr().err
    assert error.startswith(f"error: {argument}")
    assert others not in error


def test_a_folder_above_runs_names_them(run, capsys):
    assert main([str(run.parent)]) == 1
    assert f"Runs below it: {run}" in capsys.readouterr().err


def test_without_a_best_checkpoint_the_last_is_offered(run, capsys):
    shutil.rmtree(run / "checkpoints" / "best")
    assert main([str(run), "checkpoint=best"]) == 1
    error = capsys.readouterr().err
    assert "no epoch kept every cost limit. Use checkpoint=last" in error


def last_checkpoint(run):
    return next((run / "checkpoints" / "last").iterdir())


def test_a_truncated_checkpoint_is_named(run, capsys):
    path = last_checkpoint(run)
    path.write_bytes(path.read_bytes()[:2000])
    assert main([str(run)]) == 1
    assert path.name in capsys.readouterr().err
    assert not (run / "evaluation.json").exists()


class Trap:
    """Unpickling it makes a file."""

    def __init__(self, path):
        self.path = str(path)

    def __reduce__(self):
        return open, (self.path, "w")


@pytest.mark.parametrize("bare", [True, False])
def test_a_checkpoint_runs_no_code(run, bare, tmp_path, capsys):
    sprung = tmp_path / "sprung"
    path = last_checkpoint(run)
    if bare:
        path.write_bytes(pickle.dumps(Trap(sprung), protocol=2))
    else:
        with zipfile.ZipFile(path) as archive:
            members = {name: archive.read(name) for name in archive.namelist()}
        with zipfile.ZipFile(path, "w") as archive:
            for name, content in members.items():
                trapped = not name.endswith(".json")
                archive.writestr(
                    name, pickle.dumps(Trap(sprung), protocol=2) if trapped else content
                )
    assert main([str(run)]) == 1
    assert path.name in capsys.readouterr().err
    assert not sprung.exists()


def skip_without_opengl():
    env = make_env("PointGoal0", seed=0, num_threads=1)
    env.reset()
    try:
        env.render(rows=0, width=16, height=16)
    except OpenGLError as error:
        pytest.skip(f"no pictures here: {error}")


def test_the_video_shows_an_episode(run):
    imageio = pytest.importorskip("imageio.v2", reason="needs the extra 'video'")
    pytest.importorskip("imageio_ffmpeg", reason="needs the extra 'video'")
    skip_without_opengl()
    film = MANNERS["mp4"]
    result = evaluate(run, options(episodes=1, video=True))
    assert result.files[-1] == run / "evaluation.mp4"
    with imageio.get_reader(run / "evaluation.mp4") as reader:
        facts = reader.get_meta_data()
        frames = np.stack([frame for frame in reader])  # noqa: C416, a list() would ask for its length
    assert facts["codec"] == "h264"
    assert facts["pix_fmt"].startswith("yuv420p")
    assert len(frames) == NUM_STEPS // film.steps_per_frame
    assert frames.shape[2] == film.width
    # below the picture stands a white line with black text
    caption = frames[:, film.height + 2 :]
    assert np.median(caption) > 240
    assert caption.min() < 80
    assert np.abs(frames[0, : film.height].astype(float) - frames[-1, : film.height]).max() > 50
    assert not list(run.glob(".*unfinished*"))


def test_what_an_evaluation_records_is_what_it_measured(run):
    """Seven episodes of three worlds, which go on together until the last one is done."""
    result = evaluate(run, options(record=True, name="kept"))
    assert [path.name for path in result.files] == [
        *("evaluation_kept.json", "evaluation_kept.csv", "evaluation_kept.transitions"),
    ]
    steps = read_recording(result.files[-1])
    assert steps.shape == (3, 3 * NUM_STEPS)
    returns = steps["next", "reward"].double().reshape(3, 3, NUM_STEPS).sum(-1)
    with result.files[1].open() as table:
        found = [float(row["return"]) for row in csv.DictReader(table)]
    # three of the first world, two of the others
    expected = [*returns[0].tolist(), *returns[1:, :2].flatten().tolist()]
    assert found == pytest.approx(expected, abs=1e-5)
    evaluate(run, options(episodes=1, num_envs=1, record=True, name="kept"))
    assert read_recording(result.files[-1]).shape == (1, NUM_STEPS)


@pytest.mark.parametrize("suffix", ["gif", "webp"])
def test_an_animated_picture_shows_the_same_episode(run, tmp_path, suffix):
    skip_without_opengl()
    film, path = MANNERS[suffix], tmp_path / f"episode.{suffix}"
    found = [
        evaluate(run, options(episodes=2, picture=str(path), **extra))
        for extra in ({}, {"camera": "fixedfar"})
    ]
    assert found[0].files[-1] == path
    with Image.open(path) as picture:
        assert picture.info["loop"] == 0
        assert picture.n_frames == -(-NUM_STEPS // film.steps_per_frame)
        frames = []
        for frame in range(picture.n_frames):
            picture.seek(frame)
            picture.load()
            frames.append(np.asarray(picture.convert("RGB"), dtype=float))
    assert {frame.shape[1] for frame in frames} == {film.width}
    caption = np.stack(frames)[:, film.height + 4 :]
    assert np.median(caption) > 240
    assert caption.min() < 110
    # something moves, and what stands still is the same in all frames
    moved = np.abs(frames[0] - frames[-1])[: film.height].max(-1) > 40
    assert 0.0 < moved.mean() < 0.5
    assert [e.estimates["episode_return"] for e in found] == [
        found[0].estimates["episode_return"]
    ] * 2
    assert not list(tmp_path.glob(".*unfinished*"))
