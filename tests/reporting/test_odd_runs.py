"""One odd run never stops the report, and learns and shows nothing of this machine."""

import json
import os
import re

import yaml
from synthetic import EVALUATION, SUITE, write_run

from safe_rl.cli.report import main
from safe_rl.files import printable
from safe_rl.reporting import ReportOptions, build_report

SECRET = "hush-hush"


def change(run, **changes):
    config = yaml.safe_load((run / "config.yaml").read_text()) | changes
    kept = {key: value for key, value in config.items() if value is not ...}
    (run / "config.yaml").write_text(yaml.safe_dump(kept))


def change_env(run, **changes):
    change(run, env={**SUITE.environments["PointGoal1"], **changes})


def evaluate(run, text):
    (run / "evaluation.json").write_text(text)


def table(run, text):
    (run / "progress.csv").write_text(text and f"{text}\n")


def instead(run, name):
    """The name of a file that is there no more."""
    (run / name).unlink(missing_ok=True)
    return run / name


HEAD = "epoch,steps,episodes,episode_return,episode_cost,cost_rate,time_total"
FREE = "steps,episode_return,time_total\n2000,1,1"
# what is wrong with a run that is left out
UNREADABLE = {
    "seed": lambda run: change(run, seed="abc"),
    "unknown cost": lambda run: change(run, cost_limits={"cost_of_living": 3.0}),
    "limit": lambda run: change(run, cost_limits={"cost": "low"}),
    "algo": lambda run: change(run, algo="cpo"),
    "env": lambda run: change(run, env="PointGoal1"),
    "frames": lambda run: change(run, frames="many"),
    "init_from": lambda run: change(run, init_from={"a": 1}),
    "path": lambda run: change_env(run, name="../../../etc/passwd", robot_base="../../robot"),
    "secret": lambda run: change(run, algo={"name": "${oc.env:SECRET}"}),
    "code": lambda run: (run / "config.yaml").write_text(
        "algo: !!python/object/apply:os.system ['touch trace']"
    ),
    "terminal": lambda run: change(run, algo={"name": "a\x1b[31m"}),
    "binary table": lambda run: (run / "progress.csv").write_bytes(b"\x00\xff" * 99),
    "steps back": lambda run: table(run, HEAD + "\n1,1000,1,1,1,1,1\n2,900,1,1,1,1,2"),
    "table is a folder": lambda run: instead(run, "progress.csv").mkdir(),
    "table is a pipe": lambda run: os.mkfifo(instead(run, "progress.csv")),
}  # fmt: skip
# what is wrong with a file of a run that is kept
UNREADABLE_FILES = {
    "half an evaluation": lambda run: evaluate(run, '{"estimates": {"episode_ret'),
    "evaluation is a list": lambda run: evaluate(run, '["estimates"]'),
    "deep": lambda run: evaluate(run, "[" * 100_000),
    "certificate is a list": lambda run: (run / "certificate.json").write_text("[3]"),
    "unfinished row": lambda run: (run / "progress.csv").open("a").write("9,9000,"),
    "overrides": lambda run: (run / ".hydra/overrides.yaml").write_text("{"),
    "hydra": lambda run: (run / ".hydra/hydra.yaml").write_text("hydra: [[["),
}  # fmt: skip
# what looks odd, and is shown
UNUSUAL = {
    "mathematics": lambda run: change(run, algo={"name": r"a $\foo$ b"}),
    "markup": lambda run: change(run, algo={"name": "<script>alert(1)</script>|`*_["}),
    "braces": lambda run: change_env(run, name="{0.__class__} {{7*7}} {% raise %}"),
    "long key": lambda run: change_env(run, **{"k" * 9_000: 1}),
    "formula": lambda run: change(run, algo={"name": "=cmd()"}, cost_limits=None),
    "no name": lambda run: change(run, env={}, init_from="/etc"),
    "no limits": lambda run: change(run, cost_limits=...),
    "no costs": lambda run: [change(run, algo={"name": "a"}, cost_limits={}), table(run, FREE)],
    "infinite": lambda run: table(run, HEAD + "\n1,1000,1,inf,inf,-inf,1\n2,2000,1,nan,1,1,2"),
    "nothing finished": lambda run: table(run, HEAD + "\n1,1000,0,,,,1\n2,2000,0,,,,2"),
    "NaN": lambda run: evaluate(run, json.dumps(EVALUATION).replace("13.0", "NaN")),
}


def report(tmp_path, damages):
    """A report of a good run and one for every damage: runs by folder, what was left out, files."""
    root = tmp_path / "runs"
    write_run(root, folder="good", epochs=2)
    for number, damage in enumerate(damages):
        damage(write_run(root, seed=number + 1, folder=f"odd{number}", epochs=2))
    assert main([str(root), "seeds=1"]) == 0
    found = build_report(root, SUITE, ReportOptions(seeds=1))
    texts = [path.read_bytes() for path in (root / "report").iterdir()]
    assert not any(SECRET.encode() in text for text in texts)
    html = (root / "report/report.html").read_text()
    links = re.findall(r'(?:src|href)="([^"]*)"', html)
    assert all(link.startswith(("data:", "#")) for link in links)
    assert "<script" not in html
    return {run.directory.name: run for run in found.runs}, found.skipped


def test_runs_that_cannot_be_read_are_left_out_with_their_reasons(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SECRET", SECRET)
    runs, skipped = report(tmp_path, UNREADABLE.values())
    assert set(runs) == {"good"}
    folders = {place.name: reason for place, reason in skipped.items()}
    for number, name in enumerate(UNREADABLE):
        assert folders.pop(f"odd{number}"), name
    assert not folders
    shown = capsys.readouterr().err
    lines = [printable(f"{place}: {reason}") for place, reason in skipped.items()]
    assert [line for line in lines if line not in shown] == []
    assert not (tmp_path / "trace").exists()


def test_files_that_cannot_be_read_are_left_out_and_their_runs_kept(tmp_path):
    runs, skipped = report(tmp_path, UNREADABLE_FILES.values())
    assert len(runs) == 1 + len(UNREADABLE_FILES)
    assert not any({"evaluations", "certificate"} & run.notes.keys() for run in runs.values())
    own = {part for place in skipped for part in place.parts if part.startswith("odd")}
    assert own == {f"odd{number}" for number in range(len(UNREADABLE_FILES))}
    assert len(skipped) == len(UNREADABLE_FILES)


def test_what_looks_odd_is_shown(tmp_path):
    runs, skipped = report(tmp_path, UNUSUAL.values())
    assert len(runs) == 1 + len(UNUSUAL)
    assert not skipped
