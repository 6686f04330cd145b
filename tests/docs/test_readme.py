"""README is one page, with the two commands that CI and readers carry out."""

import re

import render_suite
from commands import ROOT
from PIL import Image

from safe_rl.envs.families import env_names

README = (ROOT / "README.md").read_text()
FAMILIES = ROOT / "docs" / "environments" / "suite.md"


def test_it_is_one_page():
    assert len(README.split()) <= 900


def test_the_first_paragraph_says_what_is_safe():
    first = " ".join(README.split("\n\n")[1].split())
    assert "Training is not safe" in first
    assert "certifies is the trained policy" in first


def test_commands_are_there():
    for command in ("run", "test"):
        found = re.search(rf"<!-- command: {command} -->\n```\n(.*)\n```", README)
        assert found[1].startswith("python3 -m venv")


def test_every_family_has_its_small_picture_which_the_script_redraws():
    shown = {path.name for path in (FAMILIES.parent / "pictures").iterdir()}
    drawn = {name for name in render_suite.PICTURES if name.startswith("environments/")}
    assert drawn == {f"environments/pictures/{name}" for name in shown}
    for name in shown:
        assert f"](pictures/{name})" in FAMILIES.read_text()
        assert (FAMILIES.parent / "pictures" / name).stat().st_size < 25_000
        assert Image.open(FAMILIES.parent / "pictures" / name).size == render_suite.SIZE


def test_the_table_of_families_is_complete():
    text = FAMILIES.read_text()
    rows = re.findall(r"`python train\.py env=(\w+)[^`]*` \|$", text, re.MULTILINE)
    others = {"gymnasium", "torchrl", "safety_gymnasium"}
    assert others <= set(rows)
    assert set(rows) - others <= set(env_names())
