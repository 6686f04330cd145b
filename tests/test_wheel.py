"""The wheel holds everything that the commands need, and works without the checkout."""

import os
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import pytest
from commands import ROOT, SMALL

from safe_rl.runs.table import read_table

SHORT = (*SMALL, "frames=40")


def run(*words, cwd, **environment):
    outside = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    result = subprocess.run(
        list(map(str, words)), cwd=cwd, env=outside | environment,
        capture_output=True, text=True, timeout=600, check=False,
    )  # fmt: skip
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """Built from a copy, because building leaves its traces in the folder."""
    copy = tmp_path_factory.mktemp("copy")
    tracked = ("pyproject.toml", "setup.py", "README.md", "LICENSE", "safe_rl", "conf")
    run("cp", "-r", *(ROOT / name for name in tracked), copy, cwd=ROOT)
    build = "from setuptools.build_meta import build_wheel; build_wheel('dist')"
    run(sys.executable, "-c", build, cwd=copy)
    return next((copy / "dist").glob("*.whl"))


def test_it_holds_what_is_no_code_too(wheel):
    held = set(zipfile.ZipFile(wheel).namelist())
    own = [path for path in (ROOT / "safe_rl").rglob("*") if path.is_file()]
    expected = {str(p.relative_to(ROOT)) for p in own if p.suffix not in (".pyc", ".pyi")}
    expected |= {f"safe_rl/{path.relative_to(ROOT)}" for path in (ROOT / "conf").rglob("*.yaml")}
    assert expected <= held
    kinds = {Path(name).suffix for name in expected}
    assert {".py", ".typed", ".xml", ".yaml", ".jinja"} <= kinds
    assert all(name.split("/")[0] in ("safe_rl", wheel.name[:-17] + ".dist-info") for name in held)


@pytest.mark.slow
def test_it_trains_and_evaluates_where_there_is_no_checkout(wheel, tmp_path):
    run(sys.executable, "-m", "venv", "--without-pip", tmp_path / "venv", cwd=tmp_path)
    python = tmp_path / "venv" / "bin" / "python"
    # the libraries from here; what is installed for editing here is not among them
    code = "import sysconfig; print(sysconfig.get_path('purelib'))"
    own = Path(run(python, "-c", code, cwd=tmp_path).strip())
    (own / "libraries.pth").write_text(sysconfig.get_path("purelib"))
    install = ("-m", "pip", "--python", python, "install", "--no-deps", "--no-index", wheel)
    run(sys.executable, *install, cwd=tmp_path)

    work = tmp_path / "work"
    (work / "mine" / "algo").mkdir(parents=True)
    (work / "mine" / "algo" / "mine.yaml").write_text(
        "# @package _global_\ndefaults: [cpo, _self_]\nalgo: {name: mine}\n"
    )
    safe_rl = python.with_name("safe-rl")
    where = run(python, "-c", "import safe_rl; print(safe_rl.__file__)", cwd=work)
    assert Path(where.strip()).is_relative_to(tmp_path / "venv")
    run(safe_rl, "train", "env=PointGoal1", "algo=cpo", *SHORT, "hydra.run.dir=first", cwd=work)
    assert read_table(work / "first" / "progress.csv")["steps"] == [40]
    own = ("--config-dir", "mine", "algo=mine", *SHORT)
    run(python, "-m", "safe_rl", "train", *own, "hydra.run.dir=second", cwd=work)
    assert "name: mine" in (work / "second" / "config.yaml").read_text()
    assert "2 episodes" in run(safe_rl, "evaluate", "first", "episodes=2", cwd=work)
    run(safe_rl, "report", ".", cwd=work)
    assert (work / "report" / "report.html").is_file()
