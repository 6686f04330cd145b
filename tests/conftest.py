"""What holds for every test."""

import sys
from importlib.util import find_spec

import pytest

import safe_rl  # noqa: F401, has to come before torch

# isort: split
import torch

# as many processes as cores run tests: a second thread in each would only be in the way
torch.set_num_threads(1)
# TensorDict looks for pandas at every value that a module writes: where there is none, Python would
# search all of its path each time, a fifth of the seconds of small updates
if find_spec("pandas") is None:
    sys.modules["pandas"] = None  # type: ignore[assignment]


@pytest.fixture(autouse=True)
def _seed():
    """Every test starts from the same random state, whatever ran before it."""
    torch.manual_seed(0)


def pytest_terminal_summary(terminalreporter):
    """Print what tests have recorded, such as the share of chaotic golden rows: drift shows."""
    recorded: dict[str, list[str]] = {}
    for report in terminalreporter.getreports("passed") + terminalreporter.getreports("failed"):
        for name, value in getattr(report, "user_properties", ()):
            if report.when == "call":
                recorded.setdefault(name, []).append(str(value))
    for name, values in recorded.items():
        terminalreporter.write_line(f"{name}: {', '.join(sorted(values))}")
