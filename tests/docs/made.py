"""The algorithms' pages, and what pages ask the site to make: `<!-- made: measured ppo -->`."""

import re

from commands import ROOT
from run_configs import CONF

DOCS = ROOT / "docs"
ALGORITHMS = sorted(path.stem for path in (CONF / "algo").glob("*.yaml"))


def page_of(algo):
    return (DOCS / "algorithms" / f"{algo}.md").read_text()


def made(page, name):
    """What stands behind the mark's name, None without one."""
    found = re.search(rf"<!-- made: {name} (.*?) -->", page)
    return found and found[1]


def columns_of(algo):
    """Groups of the columns that an algorithm logs."""
    (line,) = re.findall(r"^Groups of \[columns\].*: (.*)\.$", page_of(algo), re.M)
    return re.findall(r"`(\w+)`", line)
