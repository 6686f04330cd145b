"""Pages of the algorithms: what each begins with, and its parts in order."""

import pytest
from made import ALGORITHMS, made, page_of


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_a_page_has_its_parts_in_order(algo):
    page = page_of(algo)
    heads = ("## Options", "## Measured", "## When to choose it", "## What is logged")
    places = [page.find(f"\n{words}") for words in ("$$", *heads)]
    assert places == sorted(places)
    assert places[0] > 0
    assert f'--8<-- "conf/algo/{algo}.yaml"' in page
    assert made(page, "measured") == algo or made(page, "single") or "o results yet" in page
