"""One command for all: names, help and exit status."""

import pytest
from commands import in_a_process

from safe_rl.__main__ import COMMANDS, main


@pytest.mark.parametrize("arguments", [["-h"], ["--help"], []])
def test_help_names_the_commands(arguments, capsys):
    assert main(arguments) == (0 if arguments else 2)
    printed = capsys.readouterr().out
    assert all(name in printed for name in COMMANDS)


def test_an_unknown_command_is_refused_with_the_nearest(capsys):
    assert main(["trian", "env=PointGoal1"]) == 2
    assert "'train'" in capsys.readouterr().err


def test_a_command_gets_the_rest(tmp_path):
    said = in_a_process("-m", "safe_rl", "report", str(tmp_path), "seed=3", status=1)
    assert "Unknown option 'seed'. Did you mean 'seeds'" in said
