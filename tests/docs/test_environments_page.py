"""The example of the page on environments runs, in a fresh interpreter, as it stands there."""

import re
import subprocess
import sys
from pathlib import Path

PAGE = Path(__file__).resolve().parents[2] / "docs" / "environments.md"


def test_the_example_runs_without_importing_us_first(tmp_path):
    example = re.search(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL).group(1)
    check = (
        "assert info['positions']['hazards'].shape == (8, 3)\n"
        "assert env.spec.max_episode_steps == 1000\n"
        "info = env.step(env.action_space.sample())[-1]\n"
        "assert (info['goal_met'], info['cost_exception']) == (False, 0.0)\n"
    )
    result = subprocess.run(
        [sys.executable, "-c", example + check], cwd=tmp_path, capture_output=True, text=True
    )
    assert result.returncode == 0, result.stderr
