"""The README's example runs as it stands there."""

import re
import subprocess
import sys
from pathlib import Path

from PIL import Image

from safe_rl.envs.names import env_names

ROOT = Path(__file__).resolve().parents[2]
README = ROOT / "README.md"
sys.path.insert(0, str(ROOT / "examples"))

import render_suite  # noqa: E402


def block_after(mark):
    """The fenced block that follows an HTML comment."""
    pattern = rf"<!-- {re.escape(mark)} -->\n```\w*\n(.*?)```"
    return re.search(pattern, README.read_text(), re.DOTALL).group(1)


def test_the_library_example_trains(tmp_path):
    lines = block_after("example: library")
    assert len(lines.splitlines()) <= 25
    check = "print(float(multiplier.value))"
    result = subprocess.run(
        [sys.executable, "-c", f"{lines}\n{check}"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert result.returncode == 0, result.stderr
    multiplier = float(result.stdout.splitlines()[-1])
    assert multiplier != 1.0
    assert 0.5 < multiplier < 1.5


def test_commands_are_there():
    for command in ("run", "test"):
        assert block_after(f"command: {command}").startswith("python3 -m venv")


def test_every_family_has_its_small_picture_which_the_script_redraws():
    shown = re.findall(r'<img src="(docs/environments/pictures/\S+)"', README.read_text())
    there = {path.name for path in (ROOT / "docs/environments/pictures").iterdir()}
    drawn = {f"docs/{name}" for name in render_suite.PICTURES if "/" in name}
    assert set(shown) == drawn == {f"docs/environments/pictures/{name}" for name in there}
    for path in shown:
        assert (ROOT / path).stat().st_size < 25_000
        assert Image.open(ROOT / path).size == render_suite.SIZE


def test_the_table_of_environments_has_every_family():
    rows = re.findall(r"`python train\.py env=(\w+)[^`]*` \|$", README.read_text(), re.MULTILINE)
    others = {path.stem for path in (ROOT / "conf" / "env").glob("*.yaml")}
    assert others <= set(rows)
    assert set(rows) - others <= set(env_names())
