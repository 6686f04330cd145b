"""Names that are imported when somebody asks for them."""

import rlcompleter
import subprocess
import sys
from importlib import import_module

import pytest

LAZY = ["safe_rl", "safe_rl.envs", "safe_rl.envs.gymnasium", "safe_rl.envs.velocity"]


@pytest.mark.parametrize("package", [*LAZY, "safe_rl.evaluation"])
def test_what_is_imported_later_is_listed_at_once(package):
    module = import_module(package)
    assert set(module.__all__) <= set(dir(module))
    assert {name for name in dir(module) if not name.startswith("__")} == set(module.__all__)


def test_tab_completion_offers_it_without_having_imported_it():
    code = "import safe_rl, sys; print(*dir(safe_rl), 'torch' in sys.modules)"
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    *names, has_torch = said.stdout.split()
    assert {"Run", "load", "train"} <= set(names)
    assert has_torch == "False"


def test_pythons_completer_finds_it():
    completer = rlcompleter.Completer({"envs": import_module("safe_rl.envs")})
    assert completer.complete("envs.make_e", 0).startswith("envs.make_env")
