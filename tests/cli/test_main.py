"""One command for all: names, help and exit status."""

import pytest

from safe_rl.__main__ import COMMANDS, main


@pytest.mark.parametrize("arguments", [["-h"], ["--help"], []])
def test_help_names_the_commands(arguments, capsys):
    assert main(arguments) == (0 if arguments else 2)
    printed = capsys.readouterr().out
    assert all(name in printed for name in COMMANDS)


def test_an_unknown_command_is_refused_with_the_nearest(capsys):
    assert main(["trian", "env=PointGoal1"]) == 2
    assert "'train'" in capsys.readouterr().err


def test_a_command_gets_the_rest(tmp_path, capsys):
    assert main(["report", str(tmp_path), "seed=3"]) == 1
    assert "Unknown option 'seed'. Did you mean 'seeds'" in capsys.readouterr().err
