"""The command train.py, in this process."""

from safe_rl.cli import train


def status_of(*arguments: str) -> object:
    """Its exit status, or the line that it ends with."""
    try:
        return train.main(arguments)
    except SystemExit as end:
        return end.code


def run_train(*arguments: str) -> None:
    """A run that comes to its end."""
    assert status_of(*arguments) == 0
