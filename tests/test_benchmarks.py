"""The scripts of `benchmarks/` and `examples/` still find what they import, and measure."""

import runpy
import sys

import pytest
from commands import ROOT, in_a_process

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
@pytest.mark.parametrize(
    "words",
    [
        "velocity_throughput --envs SafeHopperVelocity --num-envs 2 --steps 2 --repeats 1",
        "train_throughput --epochs 1 num_envs=2 frames_per_batch=40 env.num_steps=20",
        "off_policy_throughput --updates 2 --repeats 1",
        "update_throughput --samples 40 --repeats 1",
    ],
)
def test_scripts_measure(words, monkeypatch, capsys):
    name, *arguments = words.split()
    script = ROOT / "benchmarks" / f"{name}.py"
    monkeypatch.setattr(sys, "argv", [str(script), *arguments])
    monkeypatch.syspath_prepend(script.parent)
    tables = runpy.run_path(str(script.with_name("against.py")))["tables"]
    runpy.run_path(str(script), run_name="__main__")
    assert tables(capsys.readouterr().out)  # which `against.py` compares


@pytest.mark.long
def test_a_script_composes_a_run_in_a_process_of_its_own():
    """Other tests of this process may have put into Hydra's store what the script forgot."""
    code = "from train_throughput import compose_config; print(compose_config(['algo=cpo']).seed)"
    assert in_a_process("-c", code, cwd=ROOT / "benchmarks") == "0\n"
