"""The command train.py, in this process."""

import sys

from safe_rl.cli import train


def status_of(*arguments: str) -> object:
    """Its exit status, or the line that it ends with."""
    before = sys.argv
    sys.argv = ["train.py", *arguments]
    try:
        return train.main()
    except SystemExit as end:
        return end.code
    finally:
        sys.argv = before


def run_train(*arguments: str) -> None:
    """A run that comes to its end."""
    assert status_of(*arguments) == 0
