"""The way in from Python does what the commands do, whatever state Hydra is in."""

import json
import math
import shutil
import signal
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pandas
import pytest
import torch
from commands import run_train
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf
from run_configs import CONF, without_times

import safe_rl
from safe_rl.cli.composing import compose_run, overrides_of
from safe_rl.envs import ConfigError
from safe_rl.reporting.archive import archive_runs, read_runs
from safe_rl.runs.folder import RunInUseError
from safe_rl.runs.table import read_table
from safe_rl.training.trainer import Trainer

SMALL = {
    **{"num_envs": 2, "frames_per_batch": 40, "env.num_steps": 20, "logger": "none"},
    **{"model": {"hidden_sizes": [8]}, "critic_update": {"minibatch_size": 20}, "num_threads": 1},
}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return safe_rl.train(
        "CarGoal1", algo="cpo", frames=120, directory=tmp_path_factory.mktemp("run"),
        cost_limits={"cost_hazards": 3, "cost": 5.5}, seed=4, **SMALL,
    )  # fmt: skip


def test_a_run_is_its_figures_environment_and_policy(run):
    assert str(run.table) == str(read_table(run.directory / "progress.csv"))
    assert run.config.cost_limits == {"cost_hazards": 3, "cost": 5.5}
    final = run.final
    assert final["cost_hazards_rate"] == run.table["cost_hazards_rate"][-1]
    returns = [value for value in run.table["episode_return"] if not math.isnan(value)]
    assert final["episode_return"] == pytest.approx(sum(returns) / len(returns))
    rollout = run.env.rollout(20, run.policy)
    assert rollout.shape == (1, 20)
    assert rollout["next", "cost_hazards"].shape == (1, 20, 1)
    assert rollout["action"].numpy().shape == (1, 20, 2)
    assert run.make_env(3, hazards_num=2).batch_size == (3,)
    with pytest.raises(ConfigError, match="hazards_num"):
        run.make_env(hazard_num=2)
    assert run.evaluate(episodes=2, num_threads=1).facts["episodes"] == 2


def test_a_run_is_opened_again(run):
    again = safe_rl.load(str(run.directory))
    assert str(again.table) == str(run.table)
    state, actions = run.env.reset(), []
    for policy in (run.policy, again.policy):
        torch.manual_seed(1)
        with torch.no_grad():
            actions.append(policy(state.clone())["action"])
    assert torch.equal(*actions)
    with pytest.raises(FileNotFoundError, match="no checkpoint 'newest'"):
        safe_rl.load(run.directory, checkpoint="newest")
    with pytest.raises(FileNotFoundError, match="not the folder of a run"):
        safe_rl.load(run.directory / "nowhere")


def test_the_report_has_the_command_of_a_run_from_python(tmp_path):
    folder = tmp_path / "mine"
    folder.mkdir()
    safe_rl.train(
        "PointGoal1", algo="cpo", frames=40, directory=tmp_path / "runs" / "a", config_dir=folder,
        cost_limits={"cost": 10}, **SMALL,
    )  # fmt: skip
    safe_rl.resume(tmp_path / "runs" / "a", frames=80)
    archive_runs(read_runs(tmp_path / "runs")[0], tmp_path / "runs", tmp_path / "kept")
    for root in ("runs", "kept"):
        (found,), skipped = read_runs(tmp_path / root)
        assert not skipped
        begin, *words = found.repeating.split(" env=PointGoal1 algo=cpo ")
        assert begin.startswith("python train.py --config-dir=")
        assert begin.endswith("mine")
        assert "'cost_limits={cost:10}' num_envs=2" in words[0]
        assert words[0].endswith(" frames=80")
        # as a plan or a slate compares it
        assert "env.num_steps=20" in found.overrides


def test_a_run_with_modules_is_opened_without_them_if_that_is_said(run, tmp_path):
    copied = shutil.copytree(run.directory, tmp_path / "copied")
    text = (copied / "config.yaml").read_text()
    (copied / "config.yaml").write_text(text.replace("import: []", "import: [nowhere]"))
    with pytest.raises(ValueError, match=r"import=nowhere.*imports=\[…\]"):
        safe_rl.load(copied)
    assert safe_rl.load(copied, imports=[]).table == run.table


def test_it_is_the_run_of_the_command(run, tmp_path):
    words = ["env=CarGoal1", "algo=cpo", "frames=120", "seed=4", "num_envs=2", "num_threads=1"]
    words += ["frames_per_batch=40", "env.num_steps=20", "logger=none", "model.hidden_sizes=[8]"]
    words += ["critic_update.minibatch_size=20", "cost_limits={cost_hazards: 3, cost: 5.5}"]
    run_train(*words, f"hydra.run.dir={tmp_path}")
    files = (folder / "progress.csv" for folder in (run.directory, tmp_path))
    first, second = map(without_times, files)
    assert first == second
    assert (tmp_path / "config.yaml").read_text() == (run.directory / "config.yaml").read_text()


def test_hydra_is_left_as_it_was(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with initialize_config_dir(str(CONF), version_base="1.3"):
        before = GlobalHydra.instance().hydra
        run = safe_rl.train(algo="ppo", frames=40, seed=1, **SMALL)
        assert run.directory.match("runs/PointGoal1/ppo/*_seed1")
        assert GlobalHydra.instance().hydra is before
        assert compose("config", overrides=["seed=7"]).seed == 7
    assert not GlobalHydra.instance().is_initialized()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"fames": 3}, "fames"),
        ({"cost_limits": {"cost_hazard": 1}}, "cost_hazards"),
        ({"imports": ["users_nowhere"]}, "import=users_nowhere"),
        ({"note": r"price \${5}", "frames": 40, **SMALL}, r"has '\$\{' .*no run could be opened"),
        ({"callbacks": 3}, "callbacks must be a list of functions"),
        ({"config_dir": "nowhere"}, "config_dir=.*nowhere: there is no such folder"),
        ({"resume": "run"}, r"safe_rl\.resume"),
        ({"directory": ""}, "names the folder of the run"),
        ({"env": {"hazards_num": 3}}, r"^env and algo are names\. .*store_config.*config_dir"),
        ({"algo": None}, "^env and algo are names"),
    ],
)
def test_errors_name_the_setting(settings, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match=message):
        safe_rl.train(**{"directory": "run", **settings})
    assert list(tmp_path.iterdir()) == []


def test_folders_of_ones_own_one_or_several(tmp_path):
    folders = [tmp_path / "first, with a comma", tmp_path / "second"]
    head = "# @package _global_\ndefaults: [ppo_lagrangian, _self_]\n"
    for place, folder in enumerate(folders):
        (folder / "algo").mkdir(parents=True)
        text = f"{head}lagrangian: {{init: {place + 1}}}\n"
        (folder / "algo" / f"mine{place}.yaml").write_text(text)
    config = compose_run(["algo=mine1"], folders)
    assert config.lagrangian.init == 2
    (tmp_path / "mine.py").write_text("imported = True\n")
    run = safe_rl.train(
        algo="mine0", frames=40, directory=tmp_path / "run", config_dir=folders[0],
        imports=str(tmp_path / "mine.py"), **SMALL,
    )  # fmt: skip
    with pytest.raises(ValueError, match="mine0"):
        safe_rl.train(algo="mine0", config_dir=None, directory=tmp_path / "none", **SMALL)
    assert run.config.lagrangian.init == 1
    assert run.config["import"] == [str(tmp_path / "mine.py")]
    assert safe_rl.load(run.directory, imports=str(tmp_path / "mine.py")).table == run.table


@pytest.mark.parametrize("text", ["it's", "a,b=c", "x: [y]", "back\\slash\\", "\\'", "", "3"])
def test_strange_texts_arrive_as_they_are(text):
    (override,) = overrides_of({"a": {"b": [text, {"c": text}]}})
    parsed = OverridesParser.create().parse_override(override)
    assert parsed.key_or_group == "a"
    assert parsed.value() == {"b": [text, {"c": text}]}


def test_what_a_run_will_not_do_is_said(tmp_path, capsys):
    short = SMALL | {"env.num_steps": 60, "cost_limits": {"cost": 5}}
    safe_rl.train(algo="ppo", frames=40, directory=tmp_path / "run", **short)
    printed = capsys.readouterr().out
    assert "No episode will reach its last step" in printed
    assert "algo=ppo does not keep cost_limits" in printed


def test_a_run_is_measured_against_other_limits(run):
    path = run.find_checkpoint("last")
    own, none = (
        run.evaluate(episodes=4, seed=5, checkpoint=path, name=name, cost_limits=limits)
        for name, limits in (("own", {}), ("none", {"cost": 0}))
    )
    assert own.facts["cost_limits"] == dict(run.config.cost_limits)
    assert none.facts["cost_limits"] == {**run.config.cost_limits, "cost": 0.0}
    costs = pandas.read_csv(none.files[1]).cost
    assert none.estimates["over_limit_cost"].value == (costs > 0).mean()
    assert own.estimates["episode_cost"] == none.estimates["episode_cost"]
    with pytest.raises(ValueError, match=r"no such cost\. Did you mean 'cost'"):
        run.evaluate(episodes=2, cost_limits={"cots": 3})


def test_a_run_is_certified(run):
    certificate = run.certify(ranking=2, episodes=4, tests=1)
    assert certificate.options.episodes == 4
    assert "4 episodes never suffice" in str(certificate)


def test_a_policy_of_the_package_is_certified_as_a_copy(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("safe_rl.evaluation.certifying.certify", certify := Mock())
    safe_rl.load("certified/PointGoal1").certify(episodes=4)
    assert certify.call_args.args[0] == Path("certified/PointGoal1")


def test_a_certificate_takes_the_threads_and_options_of_its_run(run, monkeypatch):
    monkeypatch.setattr("safe_rl.training.train.certify_run", certify := Mock())
    run.certificate_file.unlink(missing_ok=True)
    safe_rl.resume(run.directory, **{"certificate.episodes": 4})
    (call,) = certify.call_args_list
    assert call.args == (run.directory,)
    assert call.kwargs["num_threads"] == 1
    assert call.kwargs["changes"] == {**run.config.certificate, "episodes": 4}


def test_mappings_that_go_together_and_numbers_of_numpy_are_written_as_hydra_takes_them():
    given = {"env.outside": {"cost_a": [0, -1, 1]}, "seed": np.int64(3)}
    assert list(overrides_of(given)) == ["env.outside={cost_a:[0,-1,1]}", "seed=3"]
    assert list(overrides_of({"layers": np.array([8, 4])})) == ["layers=[8,4]"]
    with pytest.raises(ValueError, match=r"^loss=.*<class .*: a setting takes numbers"):
        list(overrides_of({"loss": {"_target_": Trainer}}))


def test_folders_in_the_home_are_found_however_they_are_named(run, tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(run.directory.parent))
    assert safe_rl.load(f"~/{run.directory.name}").directory == run.directory
    monkeypatch.chdir(run.directory)
    (file,) = Path("checkpoints/last").glob("*")
    opened = safe_rl.load("."), safe_rl.load(".", checkpoint=str(file))
    monkeypatch.chdir(tmp_path)
    assert all(again.policy is not None for again in opened)
    page = safe_rl.report(run.directory, out="~/page", archive="~/kept")
    assert {page.parent, Path("~/kept").expanduser()} <= {*run.directory.parent.iterdir()}
    monkeypatch.setenv("HOME", str(tmp_path))
    (taken := tmp_path / "taken").mkdir()
    for name, words in (  # the first may be the user's own
        ("config.yaml", rf"would replace {taken}/conf"),
        ("progress.csv", rf"resume\('{taken}'\)"),
    ):
        (taken / name).touch()
        with pytest.raises(FileExistsError, match=words):
            safe_rl.train("PointGoal0", algo="cpo", frames=40, directory="~/taken", **SMALL)


@pytest.mark.parametrize(
    ("algo", "key", "value"),
    [
        ("ppo", "transforms.saute.budgets", {"cost_hazards": 10}),
        ("sac", "policy_update.rates", {"alpha": 0.001}),
    ],
)
def test_mappings_take_the_place_of_what_is_none(algo, key, value):
    given = {"algo": algo, "transforms": ["saute"], key: value}
    config = compose_run(list(overrides_of(given)))
    assert OmegaConf.select(config, key) == value


@pytest.mark.long
def test_an_interrupted_run_is_resumed_to_the_same_table(run, tmp_path, monkeypatch, capsys):
    def epoch_that_is_stopped(trainer, batches):
        signal.raise_signal(signal.SIGINT)
        return own(trainer, batches)

    own, folder = Trainer.epoch, tmp_path / "a=run"
    settings = {"cost_limits": {"cost_hazards": 3, "cost": 5.5}, "seed": 4, **SMALL}
    settings["certificate.episodes"] = 1
    monkeypatch.setattr(Trainer, "epoch", epoch_that_is_stopped)
    with pytest.raises(KeyboardInterrupt):
        safe_rl.train("CarGoal1", algo="cpo", frames=120, directory=folder, **settings)
    monkeypatch.undo()
    assert f"safe_rl.resume('{folder}')" in capsys.readouterr().out
    assert not (folder / "certificate.json").exists()
    assert len(read_table(folder / "progress.csv")["steps"]) == 1
    resumed = safe_rl.resume(folder)
    assert resumed.directory == folder
    tables = [without_times(path / "progress.csv") for path in (run.directory, folder)]
    assert tables[0] == tables[1]
    assert safe_rl.resume(folder).table == resumed.table
    longer = safe_rl.resume(folder, frames=1.6e2, policy_update={"target_kl": 0.005})
    assert longer.table["steps"] == [40, 80, 120, 160]
    assert repr(longer.config.frames) == "160"
    assert longer.config.policy_update.target_kl == 0.005
    with pytest.raises(ValueError, match=r"checkpoint\.keep_last=-1: it must be"):
        safe_rl.resume(folder, checkpoint={"keep_last": -1})
    with pytest.raises(ValueError, match=r"env.num_steps=10.*cannot change"):
        safe_rl.resume(folder, **{"env.num_steps": 10})
    with pytest.raises(ValueError, match="not the folder of a run"):
        safe_rl.resume(tmp_path / "nowhere")
    assert not (tmp_path / "nowhere").exists()


def test_a_run_shows_itself(run, tmp_path):
    ignored = shutil.ignore_patterns("certificate*")
    run = safe_rl.load(shutil.copytree(run.directory, tmp_path / "run", ignore=ignored))
    lines = repr(run).splitlines()
    assert lines[0] == f"Run('{tmp_path / 'run'}'): cpo on CarGoal1"
    assert lines[1].startswith("Return ")
    assert run.certificate is None
    frame = run.to_pandas()
    assert list(frame["steps"]) == [40, 80, 120]
    assert list(frame.columns) == list(run.table)
    figure = run.plot()
    figure.savefig(run.curves_file)
    assert [axes.get_title() for axes in figure.axes] == ["Return", "Episode cost", "Cost rate"]
    page = run._repr_html_()
    assert page.startswith("<pre>Run(&#x27;")
    assert 'src="data:image/png;base64,' in page
    told = {"certified": True, "checkpoint": "c", "level": 0.9995}
    told["bounds"] = {"mean_cost": {"bound": 25.04}}
    (tmp_path / "run" / "certificate.json").write_text(json.dumps(told))
    assert repr(run).endswith("\nCertified at 99.95%: mean_cost ≤ 25.1 (c).")
    assert "episode_return" in str(safe_rl.evaluate(run, episodes=2))
    assert safe_rl.report(tmp_path, archive=f"{tmp_path}_kept").is_file()
    assert tmp_path.with_name(f"{tmp_path.name}_kept").is_dir()


def test_callbacks_see_every_epoch_and_may_end_the_run(tmp_path):
    seen = []
    early = [lambda row: seen.append(row["steps"]), lambda row: np.mean(row["steps"]) < 80, len]
    run = safe_rl.train("PointGoal1", directory=tmp_path, frames=400, callbacks=early, **SMALL)
    assert seen == run.table["steps"] == [40, 80]
    run = safe_rl.resume(tmp_path, frames=400, callbacks=[lambda row: row["steps"] < 120])
    assert run.table["steps"] == [40, 80, 120]
    assert safe_rl.resume(tmp_path, frames=200).table["steps"][-1] == 200

    def another(row):  # it would seed the generator of this run
        safe_rl.train("PointGoal1", directory=tmp_path / "other", frames=40, **SMALL)

    with pytest.raises(RunInUseError, match="this process trains a run already"):
        safe_rl.resume(tmp_path, frames=400, callbacks=[another])
