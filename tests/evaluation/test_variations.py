"""A trained policy under variations of its environment: what is changed, measured and written."""

import csv
import shutil
from pathlib import Path

import gymnasium_envs  # noqa: F401, registers Walk-v0
import numpy as np
import pytest
import yaml
from commands import composed, run_train
from omegaconf import OmegaConf
from PIL import Image

import safe_rl
from safe_rl.cli.evaluate import main
from safe_rl.evaluation import EvaluationOptions, evaluate
from safe_rl.evaluation.variations import _SETS, Variation, read_variations, varied
from safe_rl.files import CONF, read_yaml

pytestmark = pytest.mark.long

SMALL = {"num_envs": 4, "frames_per_batch": 160, "frames": 160, "logger": "none", "num_threads": 1}
QUICK = ("episodes=6", "num_envs=3", "num_threads=1")
SETS = sorted(read_yaml(_SETS))


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "run"
    keys = {"env.num_steps": 40, "model.hidden_sizes": [16], "algo": "ppo_lagrangian"}
    return safe_rl.train("PointGoal1", directory=folder, **SMALL, **keys).directory


def rows_of(folder, name="variations"):
    with (folder / f"{name}.csv").open(newline="") as file:
        return {row["variation"]: row for row in csv.DictReader(file)}


def test_every_row_is_the_evaluation_of_its_environment(run, capsys):
    rows = "{mass: {env.mass_scale: [0.5, 2]}, dense: {env.hazards_num: x1.5}}"
    assert main([str(run), f"variations={rows}", *QUICK]) == 0
    found = rows_of(run)
    assert list(found) == ["as trained", "mass 0.5", "mass 2", "dense"]
    keys = ({}, {"mass_scale": 0.5}, {"mass_scale": 2}, {"hazards_num": 12})
    for row, env in zip(found.values(), keys, strict=True):
        options = EvaluationOptions(episodes=6, num_envs=3, num_threads=1, env=env)
        estimates = evaluate(run, options).estimates
        for name, estimate in estimates.items():
            if not name.startswith("normalised"):
                ends = [float(row[f"{name}{end}"]) for end in ("", "_low", "_high")]
                np.testing.assert_allclose(ends, estimate)
    assert len({row["episode_return"] for row in found.values()}) == 4
    shown = capsys.readouterr().out
    assert "6 episodes each" in shown
    assert "left out" not in shown
    for row in found.values():
        assert f"{row['variation']} " in shown
    with Image.open(run / "variations.png") as picture:
        assert picture.width > 400
    assert main([str(run), "variations={full: {env.hazards_num: 60}}", *QUICK]) == 1
    out, err = capsys.readouterr()
    assert ("'hazards_num' is 60" in err, "as trained" in out) == (True, False)


def test_variations_may_have_other_costs(run, capsys):
    config = OmegaConf.load(run / "config.yaml")
    config.cost_limits = {"cost": 25, "cost_hazards": 20}
    OmegaConf.save(config, run / "config.yaml")
    rows = "{more: {env.constrain_vases: true}, free: {env.constrain_hazards: false}}"
    assert main([str(run), f"variations={rows}", *QUICK]) == 0
    found = rows_of(run)
    has = {
        name: [row["variation"] for row in found.values() if row[name]] for name in found["more"]
    }
    for name in ("episode_cost_hazards", "over_limit_cost_hazards_high"):
        assert has[name] == ["as trained", "more"]
    assert has["episode_cost_vases_contact"] == ["more"]
    assert has["episode_cost_low"] == ["as trained", "more", "free"]
    lines = {line.split()[0]: line for line in capsys.readouterr().out.splitlines() if line}
    assert (lines["free"].count("—"), lines["more"].count("—")) == (2, 0)
    assert "cost over 25" in lines["return"]
    assert "cost_hazards over 20" in lines["return"]
    # without the cost in all of them, the table has no place where its limit would be missed
    named = ("name=free", "env.constrain_hazards=false")
    assert main([str(run), "variations={more: {env.constrain_vases: true}}", *named, *QUICK]) == 0
    assert "limit 20 on cost_hazards is not judged: this env" in capsys.readouterr().out


def test_transforms_are_those_of_a_run_that_has_them(run, tmp_path):
    rows = "{noise: {transforms.sensor_noise.std: 0.5}, late: {transforms.action_delay.steps: 3}}"
    assert main([str(run), f"variations={rows}", "name=sensed", *QUICK]) == 0
    found = rows_of(run, "variations_sensed")
    for row, transform, key, value in (
        ("noise", "sensor_noise", "std", 0.5),
        ("late", "action_delay", "steps", 3),
    ):
        copy = Path(shutil.copytree(run, tmp_path / row))
        config = OmegaConf.load(copy / "config.yaml")
        node = yaml.safe_load((CONF / "transforms" / f"{transform}.yaml").read_text())
        config.transforms = node
        config.transforms[transform][key] = value
        OmegaConf.save(config, copy / "config.yaml")
        options = EvaluationOptions(episodes=6, num_envs=3, num_threads=1)
        estimates = evaluate(copy, options).estimates
        assert float(found[row]["episode_return"]) == estimates["episode_return"].value
        assert found[row]["episode_return"] != found["as trained"]["episode_return"]


def test_a_factor_changes_the_runs_own_value(run):
    config = OmegaConf.create({"env": {"hazards_num": 5, "size": 0.2, "kwargs": None}})
    for text, number in (("x0.5", 2), ("x1.5", 8), ("x2", 10)):
        changed = varied(config, Variation("h", text, {"env.hazards_num": text}))
        assert changed.env.hazards_num == number  # whole numbers, halves to even ones
    wider = varied(config, Variation("s", None, {"env.size": "x1.5"}))
    assert wider.env.size == pytest.approx(0.3)
    assert varied(config, Variation("s", None, {"env.size": 0.2})) is None
    deep = varied(config, Variation("g", None, {"env.kwargs.g": 5}))
    assert deep.env == {"hazards_num": 5, "size": 0.2, "kwargs": {"g": 5}}
    with pytest.raises(ValueError, match=r"no number 'env\.vases_num'"):
        varied(config, Variation("v", None, {"env.vases_num": "x2"}))


def test_what_sets_ask_for_in_vain_is_left_out(tmp_path, capsys):
    folder = tmp_path / "walk"
    small = [f"{key}={value}" for key, value in SMALL.items()]
    env = ("env=gymnasium", "env.id=Walk-v0", "env.cost_keys=[fast]", "cost_limits={fast: 3}")
    widths = ("model.hidden_sizes=[8]", f"hydra.run.dir={folder}", "certificate.episodes=0")
    run_train(*env, *small, *widths)
    assert main([str(folder), "variations=[dynamics,sensing]", "episodes=3", "num_envs=3"]) == 0
    found = rows_of(folder)
    assert [name.split()[0] for name in found] == ["as", *["noise"] * 4, *["delay"] * 4]
    shown = capsys.readouterr().out
    assert "left out: mass 0.5, mass 0.75, mass 1.5, mass 2.0: " in shown
    assert "no key 'mass_scale'" in shown
    # what is asked for by itself is an error
    assert main([str(folder), "variations={heavy: {env.mass_scale: 2}}", "episodes=3"]) == 1
    out, err = capsys.readouterr()
    assert ("no key 'mass_scale'" in err, "as trained" in out) == (True, False)
    assert main([str(folder), "variations={far: {env.kwargs.border: 9.0}}", "episodes=3"]) == 0
    assert list(rows_of(folder)) == ["as trained", "far"]


def test_a_file_of_ones_own(run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("my_set.yaml").write_text("light: {env.mass_scale: 0.7}\n")
    assert [(str(v), v.may_lack) for v in read_variations("my_set.yaml")] == [("light", False)]
    assert main([str(run), "variations=my_set.yaml", *QUICK]) == 0
    assert rows_of(run)["light"]["keys"] == "env.mass_scale=0.7"
    found = safe_rl.load(run).vary("my_set.yaml", episodes=6, num_envs=3, num_threads=1)
    assert found.rows[1].estimates["episode_return"].value == float(
        rows_of(run)["light"]["episode_return"]
    )


@pytest.mark.parametrize("name", SETS)
def test_keys_of_sets_are_taken_by_training(name):
    """Every key, as a command line has it; `x1.5` is a number there."""
    keys = {}
    for variation in read_variations(name):
        is_size = any(key.endswith("_size") for key in variation.keys)
        number = 0.25 if is_size else 4
        keys |= {k: number if str(v).startswith("x") else v for k, v in variation.keys.items()}
    transforms = {key.split(".")[1] for key in keys if key.startswith("transforms.")}
    chosen = [f"transforms=[{','.join(transforms)}]"] if transforms else []
    composed("env=PointGoal1", *chosen, *(f"{key}={value}" for key, value in keys.items()))


def test_what_concerns_elements_that_are_not_there_is_left_out():
    config = OmegaConf.create({"env": {"hazards_num": 0, "hazards_size": 0.2, "vases_num": 2}})
    named = read_variations("layout")
    kept = [str(v) for v in named if varied(config, v) is not None]
    assert kept == ["vases x0.5", "vases x2"]
    more = {"env.hazards_num": 4, "env.hazards_size": 0.3}
    assert varied(config, Variation("more", None, more)).env.hazards_size == 0.3
    config.env._target_ = "mine.make"  # what its keys mean is its own business
    size = Variation("size", None, {"env.hazards_size": 0.3})
    assert varied(config, size).env.hazards_size == 0.3
