"""What the site makes: tables, links out of `docs/`, its navigation."""

import re

import environment_tables
import links
import marks
import pytest
import yaml
from commands import ROOT

from safe_rl.envs import SUITE
from safe_rl.envs.safety_gym.config import KEYS
from safe_rl.envs.safety_gym.costs import COSTS

PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def cells(page):
    lines = (line for line in page.splitlines() if "|" in line)
    return {re.split(r" ?\| ?", line)[1].strip("`"): line for line in lines}


def test_every_key_has_its_row_below_a_heading():
    page = environment_tables.keys()
    assert KEYS.keys() <= set(cells(page))
    assert "| `0.3` | radius [m] |" in cells(page)["hazards_size"]
    assert page.index("## Hazards") < page.index("`hazards_size`") < page.index("## Vases")


def test_every_environment_and_cost_has_its_row():
    rows = cells(environment_tables.benchmark())
    assert set(SUITE) <= set(rows)
    assert "| 60 | 2 | `cost_hazards` |" in rows["PointGoal1"]
    meanings = set(environment_tables.COST_MEANINGS) - {"cost", "cost_exception"}
    assert {row.key for row in COSTS} == meanings
    assert {row.key for row in COSTS} <= set(cells(environment_tables.costs()))


def test_every_component_of_the_observation_is_explained():
    rows = cells(environment_tables.observations())
    assert "| 3 | any | m/s² |" in rows["accelerometer"]
    assert "[0, 1]" in rows["…_lidar"]
    with pytest.raises(KeyError, match="smell"):
        environment_tables.component_of("smell")


def test_pages_ask_for_every_table():
    pages = "".join(page.read_text() for page in PAGES)
    assert set(re.findall(r"<!-- made: (\w+)", pages)) == set(marks.TABLES)
    assert pages.count("<!-- made: ") == pages.count("<!-- end -->")


@pytest.mark.parametrize("page", [p for p in PAGES if "<!-- made: " in p.read_text()], ids=str)
def test_tables_on_pages_are_what_the_program_and_the_archive_give(page):
    text = page.read_text()
    assert text == marks.fill(text), "python docs/_site/marks.py writes them again"


def test_a_mark_gets_its_table_and_only_that():
    filled = marks.fill("a\n<!-- made: debug -->\nold\n<!-- end -->\nb")
    assert filled.startswith("a\n<!-- made: debug -->\n\n| ")
    assert filled.endswith("|\n\n<!-- end -->\nb")
    assert "old" not in filled


def test_pages_show_every_file_that_can_be_chosen():
    shown = re.findall(r'^--8<-- "conf/(.*)"$', "".join(p.read_text() for p in PAGES), re.M)
    files = {path.relative_to(ROOT / "conf").as_posix() for path in (ROOT / "conf").rglob("*.yaml")}
    assert set(shown) == {name for name in files if not name.startswith(("algo/paper", "hydra"))}
    assert len(shown) == len(set(shown))


def test_links_to_files_outside_lead_to_their_pages_or_are_their_names(tmp_path):
    (tmp_path / "conf").mkdir()
    (tmp_path / "conf" / "a.yaml").touch()
    text = "[a](../../conf/a.yaml) [gone](../../conf/b.yaml) [p](o.md) [c](../../CHANGELOG.md#x)"
    expected = "a [gone](../../conf/b.yaml) [p](o.md) [c](../changelog.md#x)"
    assert links.rewrite(text, "guides/x.md", tmp_path) == expected
    assert links.rewrite("[s](../docs/start.md)", "campaigns.md", tmp_path) == "[s](start.md)"


def test_equations_become_mathml_or_an_error():
    pytest.importorskip("latex2mathml", reason="of the extra docs, with which CI builds the site")
    from equations import typeset

    page = r'<span class="arithmatex">\(J_c &lt; d\)</span>'
    made = typeset(page + r'<div class="arithmatex">\[\rho\]</div>')
    assert made.count("<math") == 2
    assert "<msub><mi>J</mi><mi>c</mi></msub>" in made
    assert 'display="block"' in made
    with pytest.raises(ValueError, match="nosuch"):
        typeset(r'<span class="arithmatex">\(\nosuch x\)</span>')


def test_every_page_is_in_the_navigation_once():
    class Loader(yaml.SafeLoader):
        """What names objects of Python is none of ours."""

    Loader.add_multi_constructor("!", lambda *_: None)
    Loader.add_multi_constructor("tag:yaml.org,2002:python", lambda *_: None)
    config = yaml.load((ROOT / "mkdocs.yml").read_text(), Loader)
    named = re.findall(r"[\w/]+\.md", str(config["nav"]))
    assert len(named) == len(set(named))
    there = {p.relative_to(ROOT / "docs").as_posix() for p in (ROOT / "docs").rglob("*.md")}
    assert {page for page in there if not page.startswith("algorithms/")} <= set(named)
