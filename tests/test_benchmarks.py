"""The scripts of `benchmarks/` and `examples/` still find what they import."""

import runpy
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SCRIPTS = [*ROOT.glob("benchmarks/*.py"), *ROOT.glob("examples/[rt]*.py")]


@pytest.mark.long
@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_scripts_say_what_they_take(script, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", [str(script), "--help"])
    monkeypatch.syspath_prepend(script.parent)
    with pytest.raises(SystemExit, match="0"):
        runpy.run_path(str(script), run_name="__main__")
    assert script.name in capsys.readouterr().out


@pytest.mark.long
def test_a_script_composes_a_run_in_a_process_of_its_own():
    """Other tests of this process may have put into Hydra's store what the script forgot."""
    code = "from train_throughput import compose_config; print(compose_config(['algo=cpo']).seed)"
    command = [sys.executable, "-c", code]
    result = subprocess.run(command, cwd=ROOT / "benchmarks", capture_output=True, text=True)
    assert result.stdout == "0\n", result.stderr
