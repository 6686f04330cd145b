"""What holds for every test."""

import pytest

import safe_rl  # noqa: F401, has to come before torch

# isort: split
import torch

# as many processes as cores run tests: a second thread in each would only be in the way
torch.set_num_threads(1)


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
