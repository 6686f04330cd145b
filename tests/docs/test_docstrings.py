"""Every example in the package's docstrings does what it says."""

import doctest
import pkgutil
from importlib import import_module

import pytest
from registrations import undone

import safe_rl

MODULES = [
    "safe_rl",
    *(found.name for found in pkgutil.walk_packages(safe_rl.__path__, "safe_rl.")),
]


@pytest.mark.docs
@pytest.mark.parametrize("module", [name for name in MODULES if not name.endswith("__main__")])
def test_examples(module, request, capsys):
    found = doctest.DocTestFinder().find(import_module(module))
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS)
    with undone():
        for example in found:
            example.globs["getfixture"] = request.getfixturevalue
            runner.run(example)
    assert not runner.failures, capsys.readouterr().out
