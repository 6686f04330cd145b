"""Options of the command-line tools, and the extras they need."""

import io
import logging
import os
import re
import sys
from dataclasses import fields
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from safe_rl.checks import SettingError
from safe_rl.cli.evaluate import main as evaluate_main
from safe_rl.cli.options import keep_streams, make_options, read_options, run_command, usage
from safe_rl.evaluation.settings import EvaluationOptions
from safe_rl.extras import import_extra


def test_values_are_read_with_their_types_and_mappings_without_spaces_too():
    given = ["episodes=1_000", "video=true", "seed=3", "env.goal_size=0.4"]
    given += ["cost_limits={cost:20,cost_hazards: 5}", "env.kwargs={a:{b:1.5},c:[1,2]}"]
    env, limits = {"goal_size": 0.4, "kwargs": {"a": {"b": 1.5}, "c": [1, 2]}}, {"cost": 20.0}
    assert read_options(given, EvaluationOptions) == EvaluationOptions(
        episodes=1000, video=True, seed=3, env=env, cost_limits={**limits, "cost_hazards": 5.0}
    )


def test_a_log_into_a_closed_pipe_brings_no_traceback(monkeypatch, capsys):
    """`python train.py --info | head` printed one for every line."""
    monkeypatch.setattr(logging, "raiseExceptions", True)
    keep_streams()
    closed = io.StringIO()
    closed.close()
    logging.StreamHandler(closed).handle(logging.makeLogRecord({"msg": "line"}))
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("name", ["off", "yes", "007", "1e3", "2.50", "'a b'", "x=y"])
def test_names_stay_as_they_are_written(name):
    """Evaluations of other names are not to be written over one another."""
    assert read_options([f"name={name}"], EvaluationOptions).name == name.strip("'")


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ("env=CarGoal2", "env=CarGoal2: it must be a dictionary, such as '{key: value}'"),
        ("epsiodes=3", "Unknown option 'epsiodes'. Did you mean 'episodes'?"),
        ("episodes", "'episodes' is not an option: they are written key=value"),
        ("episodes=many", "episodes=many: it must be a valid integer"),
        ("video=maybe", "video=maybe: it must be a valid boolean"),
        ("episodes=[1", "cannot be read"),
        ("cost_limits={cost: low}", "cost_limits=.*'low'.*a valid number"),
        ("cost_limits={cost: -1}", "cost_limits=.*-1.* greater than or equal to 0"),
        ("episodes=0", "episodes=0: it must be greater than or equal to 1"),
        ("num_envs=1000000000", "num_envs=1000000000: .* equal to 100000"),
        ("name=a/b", "name=a/b: .*without /"),
        ("device=meta", "device=meta: it must be cpu; or cuda"),
        ("cvar_alpha=nan", "nan"),
    ],
)
def test_errors_say_what_to_write(argument, message):
    with pytest.raises(SettingError, match=message):
        read_options([argument], EvaluationOptions)


def test_keywords_may_be_numbers_of_numpy_and_paths():
    given = {"episodes": np.int64(3), "checkpoint": Path("a/b"), "env": {"x": np.array([1.5, 2])}}
    options = make_options(given, EvaluationOptions)
    assert (options.episodes, options.checkpoint, options.env) == (3, "a/b", {"x": [1.5, 2.0]})
    nested = {"env": {"m": {"k": (np.float32(0.5), 1)}}}
    assert make_options(nested, EvaluationOptions).env == {"m": {"k": [0.5, 1]}}
    for keys in ({"env.hazards_num": 3}, {"env": {"hazards_num": 3}}):
        assert make_options(keys, EvaluationOptions).env == {"hazards_num": 3}


def test_the_help_has_every_option_and_its_default():
    text = usage("command", EvaluationOptions)
    for field in fields(EvaluationOptions):
        assert re.search(rf"^  {field.name}(=|\.)", text, re.MULTILINE), field.name
    assert "episodes=100 " in text
    assert "seed=null " in text
    assert "  import=… " in text


def test_a_missing_package_names_its_extra():
    with pytest.raises(ModuleNotFoundError, match=r"'no_such_package'.*\.\[video\]"):
        import_extra("no_such_package.part", "video")


def test_an_error_within_a_package_is_not_taken_for_its_absence(tmp_path, monkeypatch):
    (tmp_path / "broken_package.py").write_text("import another_missing_package")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ModuleNotFoundError, match="another_missing_package") as caught:
        import_extra("broken_package", "video")
    assert "extra" not in str(caught.value)


def test_an_error_cannot_control_the_terminal(capsys):
    """Names in checkpoints and robots' files of other people are part of messages."""
    fail = Mock(side_effect=ValueError("a robot named \x1b]0;mine\x07"))
    assert run_command(fail, ["run"], "safe-rl evaluate RUN", EvaluationOptions) == 1
    assert capsys.readouterr().err == "error: a robot named ?]0;mine?\n"


def test_a_reader_that_has_read_enough_is_no_error(monkeypatch, capsys):
    """`safe-rl evaluate RUN | head -1` said "error: Broken pipe"."""
    monkeypatch.setattr("safe_rl.evaluation.evaluate", lambda *_, **__: "a result")
    for words in (["certified/PointGoal1"], ["--help"]):
        readable, writable = os.pipe()
        os.close(readable)
        monkeypatch.setattr(sys, "stdout", os.fdopen(writable, "w"))
        assert evaluate_main(words) == 0
        sys.stdout.close()
    assert capsys.readouterr().err == ""
