"""Imports point one way, as `.importlinter` says, and what is slow to import comes late."""

import pytest
from commands import ROOT, in_a_process
from importlinter.cli import EXIT_STATUS_SUCCESS, lint_imports

from safe_rl.extras import import_later


def test_imports_point_one_way():
    assert lint_imports(str(ROOT / ".importlinter"), no_cache=True) == EXIT_STATUS_SUCCESS


def test_importing_the_package_takes_no_time_and_imports_neither_torch_nor_its_parts():
    times, names, modules = in_a_process(
        "-c",
        "import sys, time; start = time.process_time(); import safe_rl\n"
        "print(time.process_time() - start); print(*dir(safe_rl))\n"
        "print(*sorted(name for name in sys.modules if name.startswith(('safe_rl', 'torch'))))",
    ).splitlines()
    assert float(times) < 0.05
    assert {"Run", "load", "train"} <= set(names.split())
    assert modules.split() == ["safe_rl", "safe_rl.extras"]


OPENMP_SAYS = {"OMP_DISPLAY_ENV": "verbose"}  # libgomp prints its settings when it is loaded


@pytest.mark.long
def test_idle_threads_sleep_if_the_package_comes_first():
    said = in_a_process("-c", "import safe_rl, torch; torch.ones(9) + 1", **OPENMP_SAYS)
    assert "GOMP_SPINCOUNT = '0'" in said
    assert "import safe_rl first" not in said


@pytest.mark.long
def test_torch_first_is_said_to_be_too_late():
    said = in_a_process("-c", "import torch\nimport safe_rl", **OPENMP_SAYS)
    assert "GOMP_SPINCOUNT = '0'" not in said
    assert "UserWarning: torch was imported before safe_rl" in said
    assert said.count("import safe_rl first") == 1


@pytest.mark.long
@pytest.mark.parametrize("setting", [{"OMP_WAIT_POLICY": "ACTIVE"}, {"GOMP_SPINCOUNT": "10"}])
def test_a_setting_of_the_users_is_kept_without_a_word(setting):
    code = "import torch, safe_rl, os; print(os.environ.get('OMP_WAIT_POLICY'))"
    assert in_a_process("-c", code, **setting).strip() == setting.get("OMP_WAIT_POLICY", "None")


@pytest.mark.long
def test_what_is_not_needed_yet_is_not_imported():
    """A fifth of the seconds in which a run begins."""
    unneeded = {"matplotlib", "scipy.optimize", "scipy.stats"}
    code = f"import sys, safe_rl.training.building; print({unneeded} & sys.modules.keys())"
    assert in_a_process("-c", code) == "set()\n"


@pytest.mark.long
@pytest.mark.parametrize(
    ("command", "arguments", "words"),
    [
        ("train", ("--help",), "PointGoal1"),
        ("train", ("--cfg", "job"), "PointGoal1"),
        ("evaluate", ("--help",), "episodes=100"),
        ("evaluate", ("runs/0", "episode=3"), "episodes"),
    ],
)
def test_help_and_configurations_are_shown_without_importing_what_trains(command, arguments, words):
    """Which takes longer than all the rest of it."""
    said = in_a_process(
        "-c",
        "import sys; sys.stderr = sys.stdout\n"
        f"from safe_rl.cli.{command} import main; sys.argv[1:] = {arguments}\n"
        "try: main()\n"
        "finally: print('slow:', {'torch', 'matplotlib'} & sys.modules.keys())",
    )
    assert words in said
    assert said.splitlines()[-1] == "slow: set()"


def test_a_part_that_cannot_be_imported_is_not_taken_for_a_missing_name(tmp_path, monkeypatch):
    """As MuJoCo raises an AttributeError if MUJOCO_GL names a library that is not there."""
    (tmp_path / "late").mkdir()
    (tmp_path / "late/part.py").write_text("None.gl")
    monkeypatch.syspath_prepend(tmp_path)
    find, _ = import_later("late", {"part": ["name"]})
    with pytest.raises(ImportError, match=r"^late\.part cannot be imported: .*no attribute 'gl'"):
        find("name")
