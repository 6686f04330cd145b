"""Options of the command-line tools, and the extras they need."""

import re
from dataclasses import fields

import pytest

from safe_rl.cli.options import OptionError, parse_options, usage
from safe_rl.evaluation.settings import EvaluationOptions
from safe_rl.extras import import_extra


def test_values_are_read_with_their_types():
    options = parse_options(
        ["episodes=1_000", "video=true", "seed=3", "env.layout_seeds_first=7", "env.goal_size=0.4"],
        EvaluationOptions,
    )
    assert (options.episodes, options.video, options.seed) == (1000, True, 3)
    assert options.env == {"layout_seeds_first": 7, "goal_size": 0.4}
    assert options == EvaluationOptions(
        episodes=1000, video=True, seed=3, env={"layout_seeds_first": 7, "goal_size": 0.4}
    )


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ("epsiodes=3", "Unknown option 'epsiodes'. Did you mean 'episodes'?"),
        ("episodes", "'episodes' is not an option: options are written key=value"),
        ("episodes=many", "'many'.*option 'episodes'"),
        ("video=7.5", "option 'video'"),
    ],
)
def test_errors_say_what_to_write(argument, message):
    with pytest.raises(OptionError, match=message):
        parse_options([argument], EvaluationOptions)


def test_the_help_has_every_option_and_its_default():
    text = usage("command", EvaluationOptions)
    for field in fields(EvaluationOptions):
        assert re.search(rf"^  {field.name}(=|\.)", text, re.MULTILINE), field.name
    assert "episodes=100 " in text
    assert "seed=null " in text


def test_a_missing_package_names_its_extra():
    with pytest.raises(ModuleNotFoundError, match=r"'no_such_package'.*safe-rl\[video\]"):
        import_extra("no_such_package.part", "video")


def test_an_error_within_a_package_is_not_taken_for_its_absence(tmp_path, monkeypatch):
    (tmp_path / "broken_package.py").write_text("import another_missing_package")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ModuleNotFoundError, match="another_missing_package") as caught:
        import_extra("broken_package", "video")
    assert "extra" not in str(caught.value)
