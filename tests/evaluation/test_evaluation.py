"""The evaluate command on a tiny trained run: what it runs, writes and refuses."""

import json
from pathlib import Path

import numpy as np
import pandas
import pytest
import yaml
from evaluated_runs import NUM_STEPS, options
from omegaconf import OmegaConf

from safe_rl.cli.evaluate import main
from safe_rl.envs import make_env
from safe_rl.evaluation import evaluate
from safe_rl.runs.folder import is_unfinished
from safe_rl.runs.run import Run


def test_the_summary_is_that_of_the_episodes(run):
    result = evaluate(run, options(cvar_alpha=0.5))
    assert [path.name for path in result.files] == ["evaluation.json", "evaluation.csv"]
    episodes = pandas.read_csv(run / "evaluation.csv")
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
    assert written["steps"] == 320
    assert written["layouts_trained_on"] == 0.0
    assert written["seed"] != 0


def test_the_seed_decides_and_the_mean_action_is_not_sampled(run):
    def returns(**changes):
        evaluate(run, options(**changes))
        return pandas.read_csv(run / "evaluation.csv")["return"].tolist()

    sampled = returns(seed=5)
    assert returns(seed=5) == sampled
    assert returns(seed=6) != sampled
    assert returns(seed=5, deterministic=True) != sampled


def test_layouts_can_be_those_of_training_or_others(run):
    trained_on = {"env": {"layout_seeds": 10, "layout_seeds_first": 0}}
    OmegaConf.save(OmegaConf.merge(Run(run).config, trained_on), run / "config.yaml")

    def known(**env):
        return evaluate(run, options(episodes=1, env=env)).facts["layouts_trained_on"]

    assert known() == 1.0
    assert known(layout_seeds_first=1000) == 0.0
    assert known(layout_seeds=None) == 0.0


def change_config(run, **changes):
    config = yaml.safe_load((run / "config.yaml").read_text())
    (run / "config.yaml").write_text(yaml.safe_dump({**config, **changes}))


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
    assert not [path for path in run.iterdir() if is_unfinished(path)]


def test_environments_are_closed_whatever_happens(run, monkeypatch):
    made = []

    def make(node, **kwargs):
        made.append(make_env(node, **kwargs))
        return made[-1]

    monkeypatch.setattr("safe_rl.evaluation.loading.make_env", make)
    evaluate(run, options(episodes=1))
    monkeypatch.setattr("safe_rl.evaluation.measuring.collect_episodes", None)
    with pytest.raises(TypeError):
        evaluate(run, options(episodes=1))
    assert [env.is_closed for env in made] == [True, True]


def test_the_best_checkpoint_is_taken_on_demand(run):
    best = max((run / "checkpoints" / "best").iterdir())
    for named in ("best", str(best)):
        facts = evaluate(run, options(episodes=1, checkpoint=named)).facts
        assert facts["checkpoint_file"] == str(best)
        assert facts["steps"] == int(best.stem.removeprefix("checkpoint-"))


def test_a_checkpoint_that_training_removes_meanwhile_is_evaluated(run):
    def make(node, **settings):
        for path in Run(run).checkpoints("last"):
            path.unlink()
        return make_env(node, **settings)

    assert evaluate(run, options(), make_env=make).facts["steps"] == 320


def test_the_command_prints_a_table(run, capsys):
    assert main([str(run), "episodes=3", "num_envs=3", "num_threads=1"]) == 0
    shown = capsys.readouterr().out
    assert shown.startswith(
        "ppo_lagrangian on PointGoal1, checkpoint last at 320 steps: 3 episodes"
    )
    assert "95 % interval" in shown
    line = next(line for line in shown.splitlines() if line.startswith("episode_cost "))
    assert line.endswith("limit 25")
    assert f"wrote {run}/evaluation.json" in shown
    # a limit on another measure is not shown as one on the mean
    change_config(run, risk={"_target_": "safe_rl.objectives.CVaR", "tail": 0.1})
    changed = ("env.hazards_num=2", "checkpoint=best")
    assert main([str(run), "episodes=3", "num_envs=3", "num_threads=1", *changed]) == 0
    shown = capsys.readouterr().out
    assert shown.startswith("ppo_lagrangian on PointGoal1, env.hazards_num=2, checkpoint best at ")
    assert "   limit 25 (CVaR, not mean)\n" in shown
