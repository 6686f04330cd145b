"""Pages that are made are what their sources make of them; loops of the algorithms run."""

import re
import sys
from pathlib import Path

import pytest

DOCS = Path(__file__).resolve().parents[2] / "docs"
sys.path.insert(0, str(DOCS))

import generate_algorithms  # noqa: E402

PAGES = generate_algorithms.pages()
PPO_LAGRANGIAN = PAGES["algorithms/ppo_lagrangian.md"]
WITH_LOOP = [name for name in PAGES if Path(name).stem in generate_algorithms.TEXTS]


@pytest.mark.parametrize("name", PAGES)
def test_pages_are_up_to_date(name):
    advice = "run python docs/generate_algorithms.py"
    assert (DOCS / name).read_text() == PAGES[name], advice


def test_settings_of_both_presets_have_rows_where_their_classes_differ():
    rows = re.findall(r"^\| `(lagrangian\.\w+)` \| (\S+) \| (\S+) \|", PPO_LAGRANGIAN, re.MULTILINE)
    found = {key: (default, paper) for key, default, paper in rows}
    assert found["lagrangian._target_"] == ("`PIMultiplier`", "`LagrangeMultiplier`")
    assert found["lagrangian.init"] == ("`0.0`", "`1.0`")
    assert found["lagrangian.lr"] == ("—", "`0.05`")
    assert found["lagrangian.saturation"][1] == "—"


@pytest.mark.parametrize("name", WITH_LOOP)
def test_the_loop_of_ones_own_runs(name):
    snippets = re.findall(r"```python\n(.*?)```", PAGES[name], re.DOTALL)
    assert len(snippets) == 1
    exec(snippets[0], {})


@pytest.mark.parametrize("name", PAGES)
def test_links_lead_somewhere(name):
    for target in re.findall(r"\]\(([^)#<]+)[)#]", PAGES[name]):
        assert target.startswith("http") or (DOCS / name).parent.joinpath(target).exists(), target
