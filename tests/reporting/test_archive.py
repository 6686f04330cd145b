"""Runs archived for others: the same report from a hundredth of the bytes, in two files."""

import gzip
import json
from functools import partial

import pytest
import yaml
from synthetic import EVALUATION, write_run

from safe_rl.cli.report import main
from safe_rl.reporting.archive import ROWS, RUNS, archive_runs, read_archive, read_runs

EPOCHS = {"returns": (0.1 + 0.2, 1e300, 2.5), "costs": (40.0, 30.0, 20.0)}
pack = partial(gzip.compress, mtime=0)
CERTIFICATE = {"checkpoint": None, "episode_return": None, "bounds": {}, "episodes": 4}
CERTIFICATE |= {"level": 0.9}


@pytest.fixture
def runs(tmp_path):
    """Two algorithms with two seeds each, with checkpoints that nobody else needs."""
    root = tmp_path / "runs"
    for algo in ("ppo", "cpo"):
        for seed in (0, 1):
            run = write_run(root, algo=algo, seed=seed, columns={algo: (1, "", 3)}, **EPOCHS)
            (run / "checkpoints").mkdir()
            (run / "checkpoints" / "big.torchrl").write_bytes(b"0" * 10_000)
            (run / "certificate.json").write_text(json.dumps(CERTIFICATE))
    return root


def keep(root, archive):
    archive_runs(read_runs(root)[0], root, archive)


def contents(folder):
    return {path.name: path.read_text() for path in folder.glob("*.csv")}


def test_every_table_is_made_again_from_an_archive(runs, tmp_path, capsys):
    kept = tmp_path / "kept"
    assert main([str(runs), f"archive={kept}"]) == 0
    assert "kept 4 runs" in capsys.readouterr().out
    assert {path.name for path in kept.iterdir()} == {RUNS, ROWS}
    assert main([str(kept), f"out={tmp_path / 'again'}"]) == 0
    # the folders of runs differ, and nothing else
    before, after = contents(runs / "report"), contents(tmp_path / "again")
    assert before.keys() == after.keys()
    assert {n: t.replace(str(kept), str(runs)) for n, t in after.items()} == before


def test_an_archive_follows_runs_that_go_on_and_is_the_same_bytes_otherwise(runs, tmp_path):
    run, kept = runs / "PointGoal1" / "ppo" / "seed0", tmp_path / "kept"
    keep(runs, kept)
    first = [path.read_bytes() for path in sorted(kept.iterdir())]
    keep(runs, kept)
    keep(kept, tmp_path / "copy")
    for folder in (kept, tmp_path / "copy"):
        assert [path.read_bytes() for path in sorted(folder.iterdir())] == first
    with (run / "progress.csv").open("a") as file:
        file.write("4,4000,1,3.0,10.0,0.02,14.4,7\n")
    with (run / "config.yaml").open("a") as file:  # `resume=` may change it
        file.write("lagrangian: {kp: 0.5}\n")
    # one of them alone: the others stay
    archive_runs([r for r in read_runs(runs)[0] if r.directory == run], runs, kept)
    again = read_archive(kept)
    assert len(again) == 4
    assert again["PointGoal1/ppo/seed0"].table["steps"][-1] == 4000
    assert "cpo" not in again["PointGoal1/ppo/seed0"].table


def test_nothing_says_where_the_runs_were_but_their_commands(runs, tmp_path):
    run, kept = runs / "PointGoal1" / "ppo" / "seed0", tmp_path / "kept"
    sources = [
        {"path": "hydra.conf", "schema": "pkg", "provider": "hydra"},
        {"path": f"{tmp_path}/conf", "schema": "file", "provider": "main"},
        {"path": f"{tmp_path}/mine/conf", "schema": "file", "provider": "command-line"},
    ]
    runtime = {"version": "1.3.8", "cwd": str(tmp_path), "config_sources": sources}
    notes = {"hydra": {"runtime": {**runtime, "output_dir": str(run)}, "job": {"name": "train"}}}
    (run / ".hydra" / "hydra.yaml").write_text(yaml.safe_dump(notes))
    checkpoint = f"{run}/checkpoints/last/checkpoint-1.torchrl"
    evaluation = {**EVALUATION, "run": str(run), "checkpoint_file": checkpoint}
    (run / "evaluation.json").write_text(json.dumps(evaluation))
    (run / "evaluation_odd.json").write_text("no evaluation")
    (run / ".hydra" / "config.yaml").write_text("env: {name: PointGoal1}\nframes: 500\n")
    code = [{"steps": 0, "version": "0.1.0", "commit": "0123456789abcdef", "changed": True}]
    (run / "code.json").write_text(json.dumps(code))
    keep(runs, kept)
    assert str(tmp_path) not in gzip.decompress((kept / RUNS).read_bytes()).decode()
    archived = read_archive(kept)
    assert archived["PointGoal1/ppo/seed0"].notes["changed"].keys() == {"frames"}
    assert "changed" not in archived["PointGoal1/ppo/seed1"].notes
    (kept_evaluation,) = archived["PointGoal1/ppo/seed0"].notes["evaluations"]
    assert kept_evaluation.keys() == evaluation.keys() - {"run", "checkpoint_file"}
    # of what is kept, a copy, whose report has the command and the code
    keep(kept, tmp_path / "copy")
    assert main([str(tmp_path / "copy"), f"out={tmp_path / 'again'}"]) == 0
    page = (tmp_path / "again" / "report.html").read_text()
    assert "--config-dir=mine/conf env=PointGoal1 algo=ppo seed=0 frames=3000" in page
    assert "0.1.0 0123456789 with changes" in page


def test_an_archive_that_is_written_half_way_has_the_runs_that_it_had(runs, tmp_path, monkeypatch):
    kept, (first, *others) = tmp_path / "kept", read_runs(runs)[0]
    archive_runs([first], runs, kept)
    once = iter([pack])
    monkeypatch.setattr(gzip, "compress", lambda text, mtime: next(once)(text))
    with pytest.raises(StopIteration):
        archive_runs(others, runs, kept)
    found, skipped = read_runs(kept)
    assert len(found) == 1
    assert not skipped


def test_a_run_may_have_a_name_that_pandas_takes_for_a_missing_number(tmp_path):
    no_episode = {"returns": "", "costs": ""}  # has ended in this run
    root = write_run(tmp_path, folder="null", limits={"cost_a": 1}, **no_episode).parent
    keep(root, tmp_path / "kept")
    assert [run.steps for run in read_runs(tmp_path / "kept")[0]] == [1000]


def test_an_archive_is_not_among_the_runs_and_keeps_others_of_their_names(runs, tmp_path, capsys):
    assert main([str(runs), f"archive={runs / 'kept'}"]) == 1
    assert "beside" in capsys.readouterr().err
    keep(write_run(tmp_path / "a").parents[1], tmp_path / "kept")
    other = write_run(tmp_path / "b", "CarGoal1").parents[1]
    assert main([str(other), f"archive={tmp_path / 'kept'}"]) == 1
    assert "its run ppo/seed0 is another one" in capsys.readouterr().err
    assert read_archive(tmp_path / "kept")["ppo/seed0"].settings["env"]["name"] == "PointGoal1"


def test_a_run_that_began_again_does_not_replace_the_longer_one(runs, tmp_path):
    kept, run = tmp_path / "kept", runs / "PointGoal1" / "ppo" / "seed0"
    keep(runs, kept)
    lines = (run / "progress.csv").read_text().splitlines(keepends=True)
    (run / "progress.csv").write_text("".join(lines[:3]))
    with pytest.raises(ValueError, match=r"ppo/seed0 has 3,000 steps.* only 2,000"):
        archive_runs(read_runs(runs)[0], runs, kept)
    assert read_archive(kept)["PointGoal1/ppo/seed0"].steps == 3000


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        (ROWS, b"no gzip", "gzip"),
        (ROWS, pack(b"run,steps\na,1\n" * 9)[:20], "no archive"),
        (ROWS, pack(b"run,steps\na,many\n"), "many"),
        (RUNS, pack(b"[" * 200_000), "no archive"),
        (RUNS, pack(b'{"a": {}}'), "no archive"),
    ],
)
def test_a_damaged_archive_is_left_out_with_its_reason(name, content, message, runs, tmp_path):
    keep(runs, tmp_path / "all" / "kept")
    (tmp_path / "all" / "kept" / name).write_bytes(content)
    write_run(tmp_path / "all")
    found, skipped = read_runs(tmp_path / "all")
    assert len(found) == 1
    assert message in skipped[tmp_path / "all" / "kept" / RUNS]


def test_a_run_of_an_archive_that_cannot_be_read_is_left_out_alone(runs, tmp_path):
    kept = tmp_path / "kept"
    keep(runs, kept)
    text = gzip.decompress((kept / RUNS).read_bytes())
    text = text.replace(b'"certificate": {', b'"certificate": {"level": "a"}, "x": {', 1)
    (kept / RUNS).write_bytes(gzip.compress(text))
    found, skipped = read_runs(kept)
    assert len(found) == 3
    assert "KeyError('checkpoint')" in skipped[kept / "PointGoal1" / "cpo" / "seed0"]
