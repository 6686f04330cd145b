"""Folders and checkpoints of somebody else: nothing leads out of them, or is used unchecked."""

import math
import shutil

import pytest
import torch
import yaml
from point_mass_runs import point_mass_trainer, trainer_of
from run_configs import off_policy_config
from torchrl.checkpoint import CheckpointError

from safe_rl.cli.report import ReportOptions, report
from safe_rl.evaluation.loading import load_policy, robot_of
from safe_rl.evaluation.policies import pack_policy
from safe_rl.files import load_tensors, replace_text, save_tensors
from safe_rl.runs.checkpoints import CheckpointStore
from safe_rl.runs.folder import lock_folder
from safe_rl.runs.loggers import TensorboardLogger
from safe_rl.runs.run import Run

MINE = "export SECRET=1"


def listing(folder):
    return sorted(path.name for path in folder.iterdir())


def test_a_link_in_the_place_of_an_unfinished_file_is_not_followed(tmp_path, monkeypatch):
    """Not even if its name could be foreseen."""
    mine, run = tmp_path / "bashrc", tmp_path / "run"
    run.mkdir()
    mine.write_text(MINE)
    with monkeypatch.context() as patch:
        patch.setattr("secrets.token_hex", lambda size: "0a")
        (run / ".progress.0a.csv").symlink_to(mine)
        with pytest.raises(FileExistsError):
            replace_text(run / "progress.csv", "steps\n")
    (run / "code.json").symlink_to(mine)
    replace_text(run / "code.json", "[]")  # takes the link's place
    assert mine.read_text() == MINE
    assert (run / "code.json").read_text() == "[]"
    assert listing(run) == [".progress.0a.csv", "code.json"]


@pytest.mark.parametrize(
    "place", ["transitions", "checkpoints", "checkpoints/last", "checkpoints/best", "code.json"]
)
def test_a_folder_with_links_is_not_written_to(place, tmp_path):
    mine, run = tmp_path / "mine", tmp_path / "run"
    mine.mkdir()
    (mine / "00000000.pt").touch()
    (run / place).parent.mkdir(parents=True)
    (run / place).symlink_to(mine)
    with pytest.raises(ValueError, match=rf"{place} is a link"), lock_folder(Run(run).lock_file):
        pass
    with pytest.raises(ValueError, match=rf"{place} is a link"):  # nor given away
        pack_policy(run, tmp_path / "exported")
    assert listing(mine) == ["00000000.pt"]


@pytest.mark.parametrize("name", ["../elsewhere", "..", "../", "a/b"])
def test_events_stay_in_the_folder_of_the_run(name, tmp_path):
    with pytest.raises(ValueError, match="it names a folder in that of the run"):
        TensorboardLogger(exp_name=name, log_dir=str(tmp_path / "run"))
    assert listing(tmp_path) == []


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        ({"env": {"name": ".."}}, "env"),
        ({"algo": {"name": "../mine"}}, "algo"),
        ({"algo": 3}, "algo"),
        ({"import": 5}, "import"),
        ({"seed": "x"}, "seed"),
        ({"cost_limits": [25]}, "cost_limits"),
        ({"transforms": "saute"}, "transforms"),
    ],
)
def test_a_configuration_that_no_run_writes_is_refused_in_one_line(changes, key, tmp_path):
    settings = {"env": {"name": "a"}, "algo": {"name": "b"}, "seed": 0, "cost_limits": {}}
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(settings))
    assert Run(tmp_path).seed == 0
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(settings | changes))
    with pytest.raises(ValueError, match=f"it lacks a usable {key}\\.$"):
        Run(tmp_path).config  # noqa: B018


@pytest.mark.parametrize("content", ["[1]", "{}", '"x"'])
def test_a_note_about_a_robot_that_no_run_writes_is_refused(content, tmp_path):
    (tmp_path / "robot.json").write_text(content)
    with pytest.raises(ValueError, match="is not as a run writes it"):
        robot_of(Run(tmp_path), {"robot_base": "mine.xml"})


def test_a_linked_report_is_not_written(tmp_path):
    mine = tmp_path / "mine"
    mine.mkdir()
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "report").symlink_to(mine)
    with pytest.raises(ValueError, match="report is a link"):
        report(tmp_path / "runs", ReportOptions())
    assert not listing(mine)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run of two epochs, and the trainer of it."""
    folder = tmp_path_factory.mktemp("trained") / "run"
    trainer = point_mass_trainer(folder, "frames=320")
    trainer.run()
    return folder, trainer


def edited(folder, tmp_path, part, edit):
    run = shutil.copytree(folder, tmp_path / "run")
    for path in (Run(run).checkpoints_folder / "last").iterdir():
        content = load_tensors(path)
        edit(content["parts"][part])
        save_tensors(path, content)
    return run


@pytest.fixture(scope="module")
def off_policy(tmp_path_factory):
    folder = tmp_path_factory.mktemp("off_policy") / "run"
    config = off_policy_config("algo=sac_lagrangian", "memory.n_steps=3", "frames=320")
    trainer = trainer_of(config, folder)
    trainer.run()
    return folder, trainer


OF_TRANSITIONS = [
    (
        lambda s: s["steps"].update(observation=torch.ones(308, 3)),
        r"'observation' is .* \[308, 3\], .* \[308, 4\]",
    ),
    (
        lambda s: s["steps"].update({"next/reward": torch.ones(308, 1).long()}),
        "'next/reward' is torch.int64",
    ),
    (lambda s: s["steps"].update(action=torch.ones(9, 2)), r"'action' is .* \[9, 2\]"),
    (lambda s: s["steps"].update(action=[1.0]), r"'action' is .* \[1\]"),
    (lambda s: s["steps"].pop("next/cost"), "there is no 'next/cost'"),
    (lambda s: s["steps"].pop("steps_to_next_obs"), "there is no 'steps_to_next_obs"),
    (lambda s: s.update(size=10**9), "are too many"),
    (lambda s: s["writer"].update(_cursor=-1), "308 transitions, the next at -1"),
    (lambda s: s["tail"].update(action=torch.ones(4, 3, 1)), r"'action' is .* \[4, 3, 1\]"),
    (
        lambda s: s.update(tail={k: v[:2] for k, v in s["tail"].items()}, tail_shape=[2, 3]),
        r"\[2, 3, .\], .* \[4, 3, .\]",
    ),
]


@pytest.mark.parametrize(
    ("part", "edit", "words"),
    [
        *(("memory", *row) for row in OF_TRANSITIONS),
        ("progress", dict.clear, "there is no 'epoch'"),
        ("accounting", lambda state: state["totals"].fill_(math.nan), "must be finite"),
        ("accounting", lambda state: state["totals"].neg_(), "not below 0"),
        ("accounting", lambda state: state["open_sums"][:, 0].fill_(-3), "not below 0"),
        ("accounting", lambda state: state.update(totals=[1.0]), "'totals' is a list"),
        ("accounting", lambda state: state.update(open_sums=torch.ones(9, 3)), "of the shape"),
        ("policy_update", lambda state: state.update(optimizer=[]), ""),
        ("algorithm", lambda state: state.update(tracker=[]), "there is no 'costs'"),
        ("actor", lambda state: state.update({"\x1b[31m": torch.ones(1)}), r"\?\[31m"),
    ],
)
def test_a_part_of_another_kind_is_refused_in_a_line(
    part, edit, words, trained, off_policy, tmp_path
):
    folder, trainer = off_policy if part == "memory" else trained
    path = Run(edited(folder, tmp_path, part, edit)).newest_checkpoint()
    match = f"checkpoint-000000000320.torchrl: its '{part}' does not fit: .*{words}"
    with pytest.raises(CheckpointError, match=match) as caught:
        CheckpointStore.load(path, trainer.components)
    assert str(caught.value).isprintable()


def test_a_policy_of_nan_is_not_evaluated(trained, tmp_path):
    def edit(state):
        for value in state.values():
            value.fill_(torch.nan)

    path = Run(edited(trained[0], tmp_path, "actor", edit)).newest_checkpoint()
    config, env = trained[1].writer.config, trained[1].env
    with pytest.raises(CheckpointError, match="weights that are NaN or infinite"):
        load_policy(config, env, path, torch.device("cpu"))
