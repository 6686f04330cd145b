"""Which code carried out a run, of checkouts made for it."""

import json
import subprocess
import sys
from types import SimpleNamespace

import pytest

import safe_rl
from safe_rl.reporting.tables import read_code
from safe_rl.runs import writing
from safe_rl.runs.run import Run
from safe_rl.runs.writing import code_of, note_code


@pytest.fixture
def checkout(tmp_path, monkeypatch):
    """A repository with one committed module; returns its file and what runs Git in it."""
    for name in ("AUTHOR_NAME", "COMMITTER_NAME", "AUTHOR_EMAIL", "COMMITTER_EMAIL"):
        monkeypatch.setenv(f"GIT_{name}", "somebody")

    def git(*arguments):
        result = subprocess.run(
            ["git", *arguments], cwd=tmp_path, check=True, capture_output=True, text=True
        )
        return result.stdout.strip()

    git("init", "--quiet")
    module = tmp_path / "package" / "module.py"
    module.parent.mkdir()
    module.write_text("x = 1\n")
    git("add", "package")
    git("commit", "--quiet", "--message=first")
    git("tag", "--annotate", "v1", "--message=one")  # which does not stand for the commit
    return module, git


def test_the_commit_is_gits_and_a_change_is_told(checkout):
    module, git = checkout
    commit = {"commit": git("rev-parse", "HEAD")}
    assert code_of(module) == commit | {"changed": False}
    (module.parent / "notes.txt").write_text("not under version control")
    code_of.cache_clear()
    assert code_of(module)["changed"] is False
    module.write_text("x = 2\n")
    code_of.cache_clear()
    assert code_of(module) == commit | {"changed": True}
    # a package that is installed within somebody else's checkout has no commit
    installed = module.parent / "installed.py"
    installed.write_text("x = 1\n")
    assert code_of(installed) == {"commit": None, "changed": None}


def test_the_commits_of_the_users_modules_are_noted(checkout, tmp_path, monkeypatch):
    module, git = checkout
    monkeypatch.setitem(sys.modules, "theirs", SimpleNamespace(__file__=str(module)))
    monkeypatch.setattr(writing, "allowed", lambda: ["theirs"])
    path = tmp_path / "code.json"
    note_code(path, 0)
    (entry,) = json.loads(path.read_text())
    commit = git("rev-parse", "HEAD")
    assert entry["imports"] == {"theirs": {"commit": commit, "changed": False}}
    module.write_text("x = 2\n")
    code_of.cache_clear()
    note_code(path, 100)  # continued after a change
    first, second = json.loads(path.read_text())
    assert (first, second["steps"]) == (entry, 100)
    assert second["imports"]["theirs"]["changed"] is True
    assert read_code([second]).endswith(f"theirs {commit[:10]} with changes from 100 steps on")


def test_without_git_a_run_is_noted_all_the_same(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(writing, "allowed", list)  # not the modules of other tests
    code_of.cache_clear()
    note_code(tmp_path / "code.json", 0)
    code_of.cache_clear()
    (entry,) = json.loads((tmp_path / "code.json").read_text())
    assert entry == {"steps": 0, "version": safe_rl.__version__, "commit": None, "changed": None}


def test_code_that_resumes_a_run_stands_below_what_began_it(tmp_path, monkeypatch):
    path = tmp_path / "code.json"

    def noted(commit, steps):
        known = {"version": "1", "commit": commit, "changed": False}
        monkeypatch.setattr(writing, "code_of", lambda file: known)
        note_code(path, steps)
        return [(entry["steps"], entry["commit"]) for entry in json.loads(path.read_text())]

    assert noted("a", 0) == [(0, "a")]
    assert noted("a", 100) == [(0, "a")]
    assert noted("b", 200) == [(0, "a"), (200, "b")]
    # begun anew from an earlier checkpoint
    assert noted("c", 150) == [(0, "a"), (150, "c")]
    assert Run(tmp_path).commit == "c"
    for damage in ("damaged", "[1.5]", "{}", "[]"):
        path.write_text(damage)
        assert Run(tmp_path).commit is None
    assert noted("d", 300) == [(300, "d")]
