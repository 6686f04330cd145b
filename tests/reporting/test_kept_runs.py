"""Runs that are kept for others: the same report from a hundredth of the bytes."""

import gzip
import json

import pytest
import yaml
from synthetic import write_run

from safe_rl.cli.report import main
from safe_rl.reporting.recorded import find_runs
from safe_rl.runs import table as tables
from safe_rl.runs.keeping import keep_runs
from safe_rl.runs.table import read_table

EPOCHS = {"returns": (1.0, 2.0, 2.5), "costs": (40.0, 30.0, 20.0), "rates": (0.04, 0.035, 0.03)}


@pytest.fixture
def runs(tmp_path):
    """Two algorithms with two seeds each, with checkpoints that nobody else needs."""
    root = tmp_path / "runs"
    for algo in ("ppo", "cpo"):
        for seed in (0, 1):
            run = write_run(root, algo=algo, seed=seed, **EPOCHS)
            (run / "checkpoints").mkdir()
            (run / "checkpoints" / "big.torchrl").write_bytes(b"0" * 10_000)
            (run / "certificate.json").write_text("{}")
    return root


def contents(folder):
    return {path.name: path.read_text() for path in folder.glob("*.csv")}


def test_every_table_is_made_again_from_what_is_kept(runs, tmp_path, capsys):
    kept = tmp_path / "kept"
    assert main([str(runs), f"archive={kept}"]) == 0
    assert "kept 4 runs" in capsys.readouterr().out
    assert not list(kept.rglob("progress.csv"))
    assert not list(kept.rglob("*.torchrl"))
    assert len(list(kept.rglob("certificate.json"))) == 4
    assert main([str(kept), f"out={tmp_path / 'again'}"]) == 0
    # the folders of runs differ, and nothing else
    before, after = contents(runs / "report"), contents(tmp_path / "again")
    assert before.keys() == after.keys()
    assert {n: t.replace(str(kept), str(runs)) for n, t in after.items()} == before


def test_an_archive_follows_runs_that_go_on_and_is_the_same_bytes_otherwise(runs, tmp_path):
    run, kept = runs / "PointGoal1" / "ppo" / "seed0", tmp_path / "kept"
    packed = kept / "PointGoal1" / "ppo" / "seed0" / "progress.csv.gz"
    keep_runs([run], runs, kept)
    first = packed.read_bytes()
    keep_runs([run], runs, kept)
    assert packed.read_bytes() == first
    with (run / "progress.csv").open("a") as file:
        file.write("4,4000,1,3.0,10.0,0.02,14.4\n")
    keep_runs([run], runs, kept)
    assert read_table(packed)["steps"][-1] == 4000
    # of what is kept, a copy
    keep_runs([packed.parent], kept, tmp_path / "copy")
    assert read_table(next((tmp_path / "copy").rglob("*.gz"))) == read_table(packed)


def test_nothing_says_where_the_runs_were_but_their_commands(runs, tmp_path, capsys):
    run, kept = runs / "PointGoal1" / "ppo" / "seed0", tmp_path / "kept"
    sources = [
        {"path": "hydra.conf", "schema": "pkg", "provider": "hydra"},
        {"path": f"{tmp_path}/conf", "schema": "file", "provider": "main"},
        {"path": f"{tmp_path}/mine/conf", "schema": "file", "provider": "command-line"},
    ]
    runtime = {"version": "1.3.8", "cwd": str(tmp_path), "config_sources": sources}
    notes = {"hydra": {"runtime": {**runtime, "output_dir": str(run)}, "job": {"name": "train"}}}
    (run / ".hydra" / "hydra.yaml").write_text(yaml.safe_dump(notes))
    place = {"run": str(run), "checkpoint_file": f"{run}/checkpoints/last/checkpoint-1.torchrl"}
    (run / "evaluation.json").write_text(json.dumps({**place, "episodes": 3, "name": ""}))
    (run / "evaluation_odd.json").write_text("no evaluation")
    code = [{"steps": 0, "version": "0.1.0", "commit": "0123456789abcdef", "changed": True}]
    (run / "code.json").write_text(json.dumps(code))
    keep_runs([run], runs, kept)
    keep_runs([run], runs, kept)
    archived = kept / "PointGoal1" / "ppo" / "seed0"
    texts = [path.read_text() for path in archived.rglob("*") if path.suffix in (".json", ".yaml")]
    assert not [text for text in texts if str(tmp_path) in text]
    evaluation = json.loads((archived / "evaluation.json").read_text())
    assert evaluation == {"checkpoint_file": "checkpoint-1.torchrl", "episodes": 3, "name": ""}
    assert not (archived / "evaluation_odd.json").exists()
    # of what is kept, a copy, whose report has the command and the code
    keep_runs([archived], kept, tmp_path / "copy")
    assert main([str(tmp_path / "copy"), f"out={tmp_path / 'again'}"]) == 0
    page = (tmp_path / "again" / "report.md").read_text()
    assert "--config-dir=mine/conf" in page.replace("\\", "")
    assert "0.1.0 0123456789 with changes" in page


def test_of_what_a_run_was_to_be_at_first_only_its_length_is_kept(runs, tmp_path):
    first, second = (runs / "PointGoal1" / "ppo" / f"seed{seed}" for seed in (0, 1))
    (first / ".hydra" / "config.yaml").write_text("env: {name: PointGoal1}\nframes: 500\n")
    kept = tmp_path / "kept"
    keep_runs([first, second], runs, kept)
    notes = [kept / run.relative_to(runs) / ".hydra" / "config.yaml" for run in (first, second)]
    assert yaml.safe_load(notes[0].read_text()) == {"frames": 500}
    assert not notes[1].exists()  # "not: this one"
    frames = yaml.safe_load((first / "config.yaml").read_text())["frames"]
    commands = [run.command for run in find_runs(kept)[0]]
    assert [f"frames={frames}" in command for command in commands] == [True, False]


def test_an_archive_is_not_among_the_runs(runs, capsys):
    assert main([str(runs), f"archive={runs / 'kept'}"]) == 1
    assert "beside" in capsys.readouterr().err


@pytest.mark.parametrize("content", [b"no gzip", gzip.compress(b"epoch,steps\n" * 9, mtime=0)[:20]])
def test_a_damaged_table_is_left_out(content, runs, tmp_path, capsys):
    kept = tmp_path / "kept"
    main([str(runs), f"archive={kept}"])
    (kept / "PointGoal1" / "cpo" / "seed1" / "progress.csv.gz").write_bytes(content)
    assert main([str(kept)]) == 0
    assert "damaged" in capsys.readouterr().err


def test_a_small_file_that_unpacks_to_any_size_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(tables, "_MOST_BYTES", 1000)
    (tmp_path / "progress.csv.gz").write_bytes(gzip.compress(b"0" * 10_000))
    with pytest.raises(ValueError, match="more than 1,000 bytes"):
        read_table(tmp_path / "progress.csv.gz")
