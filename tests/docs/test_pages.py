"""Every page: its snippets run, and its commands are what the program takes.

In the order in which they stand on the page: a block below `<!-- file: name -->` is that file,
blocks of Python run, and of commands, those within sentences and tables too, everything is checked
that is checked before a run begins. A command with an ellipsis is for the reader to fill in.
"""

import re
import shlex
import sys
from pathlib import Path

import pytest
from commands import ROOT, composed
from registrations import undone

from safe_rl import trust
from safe_rl.cli.export import ExportOptions
from safe_rl.cli.options import read_options
from safe_rl.cli.report import ReportOptions
from safe_rl.evaluation import EvaluationOptions
from safe_rl.evaluation.settings import CertifyOptions

PAGES = ["README.md", *(str(p.relative_to(ROOT)) for p in sorted((ROOT / "docs").rglob("*.md")))]
# snippets that have tests of their own, with more to say
TESTED_ELSEWHERE = ("README.md", "docs/algorithms")
# a package that not everybody has
LACKING = ("comes with the extra", "cannot be imported in this Python", "if torch finds this GPU")
# options of our other commands, and what else stands after the folder
SCHEMAS: dict[str, list] = {
    "evaluate": [EvaluationOptions],
    "certify": [CertifyOptions],
    "export": [ExportOptions, "FILE"],
    "report": [ReportOptions],
}
BLOCK = re.compile(r"^(?:<!-- file: (\S+) -->\n)?```(\w*)\n(.*?)^```", re.M | re.S)


def blocks(page: str) -> list[tuple[str, str, str]]:
    """What is fenced: the name of a file or "", a language or "", and the text."""
    return BLOCK.findall((ROOT / page).read_text())


def linked(page: str) -> list[str]:
    """Pages that a page links to, whose files a reader may have."""
    targets = re.findall(r"\]\(([^)#]+\.md)", (ROOT / page).read_text())
    places = [(ROOT / page).parent.joinpath(target).resolve() for target in targets]
    return [str(path.relative_to(ROOT)) for path in places if path.is_file()]


def write_file(place: Path, name: str, text: str) -> None:
    (place / name).parent.mkdir(parents=True, exist_ok=True)
    (place / name).write_text(text)


def commands(text: str) -> list[list[str]]:
    """Words of our commands in a block, without comments and the words before them."""
    lines = text.replace("\\\n", " ").splitlines()
    found = (re.search(r"(python train\.py|safe-rl \w+)( .*)?$", line) for line in lines)
    written = [match.group().removeprefix("python ") for match in found if match]
    return [shlex.split(line, comments=True) for line in written if "…" not in line]


@pytest.fixture
def workplace(tmp_path, monkeypatch):
    """The folder that a page's reader is in: a checkout, as far as pages name what is in it."""
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    monkeypatch.setattr(trust, "_ROOMS", dict(trust._ROOMS))
    with undone():
        yield tmp_path
    for name, module in list(sys.modules.items()):
        if str(getattr(module, "__file__", None)).startswith((str(tmp_path), str(ROOT / "exa"))):
            del sys.modules[name]


def inline(page: str) -> list[list[str]]:
    """Words of our commands that have keys, in sentences and tables."""
    text = BLOCK.sub("", (ROOT / page).read_text())
    found = re.findall(r"`((?:python train\.py|safe-rl \w+) [^`]+)`", text)
    return [words for code in found for words in commands(" ".join(code.split()))]


def check(words: list[str], run: Path) -> None:
    """Check a command as the program does, up to where it begins to work."""
    place = re.compile(r"^((?:resume|init_from)=)?(?:runs/[\w/.-]+|RUN_DIR)$")
    program, *arguments = [place.sub(lambda m: f"{m[1] or ''}{run}", word) for word in words]
    if program == "safe-rl":
        module, _, *options = arguments
        schema, *others = SCHEMAS[module]
        options = options[len(others) :]
        words = [o for o in options if o != "--help" and not o.startswith("import=")]
        read_options(words, schema)
        return
    # the sweeper of Optuna, which not everybody has, takes intervals
    composed(*(re.sub(r"interval\((.*?),.*\)", r"\1", word) for word in arguments))


def check_all(found: list[list[str]], run: Path, page: str) -> None:
    for words in found:
        try:
            check(words, run)
        except Exception as error:
            if any(reason in str(error) for reason in LACKING):
                continue
            raise AssertionError(f"{page}: {shlex.join(words)}: {error}") from error


@pytest.mark.parametrize("page", PAGES)
def test_snippets_run_and_commands_are_taken(page, workplace, tiny_run):
    names = {"__name__": "page"}
    for other in linked(page):
        for file, _, text in blocks(other):
            if file:
                write_file(workplace, file, text)
    for file, language, text in blocks(page):
        if file:
            write_file(workplace, file, text)
        elif language == "python" and not page.startswith(TESTED_ELSEWHERE):
            exec(compile(text, page, "exec"), names)
        elif language in ("", "sh", "bash"):
            check_all(commands(text), tiny_run.directory, page)
    check_all(inline(page), tiny_run.directory, page)


@pytest.mark.parametrize(
    "wrong", ["train.py env=PointGaol1", "train.py alog=cpo", "safe-rl evaluate RUN_DIR episode=3"]
)
def test_a_wrong_command_is_found(wrong, workplace, tiny_run):
    with pytest.raises(ValueError, match=r"Did you mean|no key|no option|Unknown"):
        check(wrong.split(), tiny_run.directory)


def test_there_are_commands_and_snippets():
    """The pattern finds them: pages that teach have both."""
    found = {page: blocks(page) for page in PAGES}
    assert ["train.py", "env=CarPush2"] in inline("docs/environments/suite.md")
    for page in ("docs/start.md", "docs/guides/environment.md", "docs/guides/gymnasium.md"):
        assert any(language == "python" for _, language, _ in found[page]), page
        assert sum(len(commands(text)) for file, _, text in found[page] if not file), page
