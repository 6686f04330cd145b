"""What the site makes: tables of the environments, links out of `docs/`, its navigation."""

import re
from pathlib import Path

import catalogue
import links
import navigation
import pytest
import yaml

from safe_rl.cli.schema import KEYS
from safe_rl.envs import SUITE, key_table
from safe_rl.envs.safety_gym.costs import COSTS

ROOT = Path(__file__).resolve().parents[2]


def cells(page):
    return {
        re.split(r" ?\| ?", line)[1].strip("`"): line for line in page.splitlines() if "|" in line
    }


def test_every_key_has_its_row_below_a_heading():
    page = catalogue.keys()
    assert {row.name for row in key_table()} <= set(cells(page))
    assert (
        "| a number above 0 and at most 1e+09 | `0.3` | radius [m] |" in cells(page)["hazards_size"]
    )
    assert page.index("## Hazards") < page.index("`hazards_size`") < page.index("## Vases")


def test_every_key_of_a_run_has_its_row_with_its_default():
    rows = cells(catalogue.run_keys())
    assert set(KEYS) <= set(rows)
    assert {"clip_epsilon", "betas", "kp", "tail", "num_collectors", "budgets"} <= set(rows)
    level = "| a number above 0.5 and below 1 | `0.95` | confidence of a certificate |"
    assert level in rows["certificate.level"]
    assert "| `256` |" in rows["batch_size"]  # which only off-policy algorithms have


def test_every_environment_and_cost_has_its_row():
    rows = cells(catalogue.benchmark())
    assert set(SUITE) <= set(rows)
    assert "| 60 | 2 | `cost_hazards` |" in rows["PointGoal1"]
    assert {row.key for row in COSTS} == set(catalogue.COST_MEANINGS) - {"cost", "cost_exception"}
    assert {row.key for row in COSTS} <= set(cells(catalogue.costs()))


def test_every_component_of_the_observation_is_explained():
    rows = cells(catalogue.observations())
    assert "| 3 | any | m/s² |" in rows["accelerometer"]
    assert "[0, 1]" in rows["…_lidar"]
    with pytest.raises(KeyError, match="smell"):
        catalogue.component_of("smell")


def test_pages_ask_for_every_table():
    pages = "".join(page.read_text() for page in (ROOT / "docs").rglob("*.md"))
    assert set(re.findall(r"<!-- made: (\w+)", pages)) == set(catalogue.TABLES)
    assert catalogue.fill("a\n<!-- made: lidars -->\nb").count("`observe_hazards`") == 1


def test_links_to_files_outside_lead_to_their_pages(tmp_path):
    (tmp_path / "conf" / "b").mkdir(parents=True)
    (tmp_path / "conf" / "b" / "c.yaml").touch()
    (tmp_path / "conf" / "a.yaml").write_text("x: 1\n")
    text = "[a](../../conf/a.yaml) [all](../../conf#top) [gone](../../conf/b.yaml) [p](other.md)"
    pages = links.linked_files({"guides/x.md": text}, tmp_path)
    assert set(pages) == {"files/conf/a.yaml.md", "files/conf/b/c.yaml.md", "files/conf.md"}
    assert "x: 1" in pages["files/conf/a.yaml.md"]
    assert "(conf/a.yaml.md)" in pages["files/conf.md"]
    below = links.linked_files({"x.md": "[b](../conf/b)"}, tmp_path)
    assert "(b/c.yaml.md)" in below["files/conf/b.md"]
    led = links.rewrite(text, "guides/x.md", tmp_path)
    assert led == (
        "[a](../files/conf/a.yaml.md) [all](../files/conf.md#top) "
        "[gone](../../conf/b.yaml) [p](other.md)"
    )


def test_equations_become_mathml_or_an_error():
    pytest.importorskip("latex2mathml", reason="of the extra docs, with which CI builds the site")
    from equations import typeset

    page = (
        r'a <span class="arithmatex">\(J_c &lt; d\)</span> <div class="arithmatex">\[\rho\]</div>'
    )
    made = typeset(page)
    assert made.count("<math") == 2
    assert "<msub><mi>J</mi><mi>c</mi></msub>" in made
    assert 'display="block"' in made
    with pytest.raises(ValueError, match="nosuch"):
        typeset(r'<span class="arithmatex">\(\nosuch x\)</span>')


def test_pages_that_the_navigation_does_not_list_are_found_with_their_titles(tmp_path):
    for name in ("b", "a", "listed", "titled"):
        (tmp_path / f"{name}.md").write_text(
            f"<!-- a mark -->\n# Heading of {name}\n\n# Not this\n"
        )
    listed = [f"{tmp_path.name}/listed.md", {"A title": f"{tmp_path.name}/titled.md"}]
    assert navigation.unlisted(listed, tmp_path) == [
        {"a: Heading of a": f"{tmp_path.name}/a.md"},
        {"b: Heading of b": f"{tmp_path.name}/b.md"},
    ]


def test_every_page_is_in_the_navigation_once():
    class Loader(yaml.SafeLoader):
        """What names objects of Python is none of ours."""

    Loader.add_multi_constructor("!!python", lambda *_: None)
    Loader.add_multi_constructor("tag:yaml.org,2002:python", lambda *_: None)
    config = yaml.load((ROOT / "mkdocs.yml").read_text(), Loader)
    named = re.findall(r"[\w/]+\.md", str(config["nav"]))
    assert len(named) == len(set(named))
    there = {p.relative_to(ROOT / "docs").as_posix() for p in (ROOT / "docs").rglob("*.md")}
    assert {page for page in there if not page.startswith("algorithms/")} <= set(named)
