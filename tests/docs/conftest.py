"""Tests of pages are a step of their own: ``pytest -m docs``."""

from pathlib import Path

import pytest

HERE = Path(__file__).parent
# examples in docstrings are tests of the package
OF_THE_PACKAGE = ("test_docstrings.py",)


def pytest_collection_modifyitems(items):
    for item in items:
        if HERE in item.path.parents and item.path.name not in OF_THE_PACKAGE:
            item.add_marker(pytest.mark.docs)
