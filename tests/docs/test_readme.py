"""The README's example runs as it stands there."""

import re
import subprocess
import sys
from pathlib import Path

README = Path(__file__).resolve().parents[2] / "README.md"


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
