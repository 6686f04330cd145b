"""Pages of the algorithms: what each begins with, its settings; its training loop runs."""

import re

import algorithm_pages
import pytest
from made import ALGORITHMS, made, page_of


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_a_page_has_its_parts_in_order(algo):
    page = page_of(algo)
    heads = ("## Options", "## Measured", "## When to choose it", "## What is logged")
    begin = ("**What it does.**", "$$", f"python train.py env=PointGoal1 algo={algo}", *heads)
    places = [page.find(f"\n{words}") for words in begin]
    assert places == sorted(places)
    assert places[0] > 0
    assert made(page, "settings") == algo
    assert algo == "bc" or made(page, "curves") == made(page, "measured") == algo


def test_settings_of_both_presets_have_rows_where_their_classes_differ():
    table = algorithm_pages.settings("ppo_lagrangian")
    rows = re.findall(r"^\| `(lagrangian\.\w+)` \| (\S+) \| (\S+) \|", table, re.MULTILINE)
    found = {key: (default, paper) for key, default, paper in rows}
    assert found["lagrangian._target_"] == ("`PIMultiplier`", "`LagrangeMultiplier`")
    assert found["lagrangian.init"] == ("`0.0`", "`1.0`")
    assert found["lagrangian.lr"] == ("—", "`0.05`")
    assert found["lagrangian.saturation"][1] == "—"


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_the_loop_of_ones_own_runs(algo):
    (loop,) = re.findall(
        r"```python\n(.*?)```", algorithm_pages.loop(made(page_of(algo), "loop")), re.S
    )
    exec(loop, {})
