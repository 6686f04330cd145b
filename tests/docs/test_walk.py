"""The way from the first page to an algorithm of one's own in the table, as a stranger goes it.

Every command is one that stands on the page that the one before leads to. It is carried out as it
stands there, but for the size of the run: few steps of short episodes, limits that any policy
keeps, and no certificate but in the first one.
"""

import itertools
import json
import re
import shlex

import pandas
import pytest
from commands import ROOT, in_a_process, run_train

from safe_rl.__main__ import main

DOCS = ROOT / "docs"
WALK = ("index.md", "start.md", "guides/environment.md", "guides/algorithm.md")
TINY = [
    *("frames=800", "num_envs=4", "frames_per_batch=200", "env.num_steps=20", "logger=none"),
    *("num_threads=1", "model.hidden_sizes=[8]", "certificate.episodes=0"),
]
FILE = re.compile(r"^<!-- file: (\S+) -->\n```\w*\n(.*?)^```", re.M | re.S)


@pytest.fixture
def place(tmp_path):
    """Where the reader is: a folder with the files of the pages, as if in a checkout."""
    for name in ("train.py", "conf"):
        (tmp_path / name).symlink_to(ROOT / name)
    for page in (*WALK, "guides/observations.md"):
        for name, text in FILE.findall((DOCS / page).read_text()):
            (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / name).write_text(text)
    return tmp_path


def command(page, *words):
    """The line of a page that has these words."""
    lines = (DOCS / page).read_text().splitlines()
    ours = ("python ", "safe-rl ")
    found = [line for line in lines if line.startswith(ours) and all(w in line for w in words)]
    assert found, f"{page} has no command with {words}"
    program, *others = shlex.split(found[0], comments=True)
    return others if program == "python" else ["-m", "safe_rl", *others]


def tiny(words, *, seeds=False, fresh=False):
    """A command of a page, a training as a tiny one; of a sweep over seeds two in a row.

    A fresh one has the folder that it gets without being told.
    """
    if words[0] == "train.py":
        kept = [w for w in words if not w.startswith(("frames=", "cost_limits="))]
        given = {w.partition("=")[0] for w in kept}
        small = [w for w in TINY if w.partition("=")[0] not in given]
        small = [w for w in small if not w.startswith("env.") or "env=corridor" not in words]
        limits = [re.sub(r"\d+", "1000", w) for w in words if w.startswith("cost_limits")]
        words = [*kept, *small, *(limits or ["cost_limits={cost: 1000}"])]
        if not fresh and not {"hydra.run.dir", "-m"} & {*given, *words}:
            words.append("hydra.run.dir=runs/one")
    if seeds:
        words = [w.replace("seed=0,10,20", "seed=0,10") for w in words] + ["hydra/launcher=basic"]
    return words


def carry_out(words, place, **how):
    """Run it in a process of its own; returns what it printed."""
    given = {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    return in_a_process(*tiny(words, **how), cwd=place, **given)


def test_every_page_leads_to_the_next():
    for page, following in itertools.pairwise(WALK):
        targets = re.findall(r"\]\(([^)#]+)", (DOCS / page).read_text())
        there = {(DOCS / page).parent.joinpath(target).resolve() for target in targets}
        assert DOCS / following in there, f"{page} does not lead to {following}"


def test_from_the_first_page_to_a_certified_policy(place):
    assert command("index.md", "env=PointGoal1")[:3] == command("start.md", "env=PointGoal1")[:3]
    small_test = ["certificate.ranking=4", "certificate.episodes=40"]
    said = carry_out([*command("start.md", "train.py", "runs/first"), *small_test], place)
    assert "with sampled actions" in said
    assert "mean_cost ≤" in said
    assert json.loads((place / "runs/first/certificate.json").read_text())["certified"]
    look = command("start.md", "safe-rl evaluate", "checkpoint=certified")
    quick = [re.sub("episodes=100", "episodes=3", word) for word in look if word != "video=true"]
    assert "3 episodes" in carry_out(quick, place)
    assert (place / "runs/first/evaluation.json").is_file()


def test_from_an_environment_and_an_algorithm_of_ones_own_to_the_table(place):
    both = command("guides/algorithm.md", "env=SlowGoal", "my_penalty.py")
    carry_out(both, place, seeds=True)
    report = command("guides/algorithm.md", "safe-rl report")
    carry_out(report, place)
    rows = pandas.read_csv(place / "runs/report/final_SlowGoal.csv").set_index("algorithm")
    assert rows.seeds.to_dict() == {"quadratic": 2, "CPO": 2}
    runs = list(place.glob("runs/SlowGoal/quadratic/**/progress.csv"))
    assert len(runs) == 2
    # what it costs to drive fast is counted beside what was there before
    columns = {"episode_cost_speed", "episode_cost_hazards", "policy_loss_penalty"}
    assert columns <= set(pandas.read_csv(runs[0]))


def test_a_simulator_of_ones_own_is_trained_on(place):
    carry_out(command("guides/environment.md", "env=corridor"), place)
    assert (place / "runs/one/progress.csv").is_file()


def test_from_nothing_to_a_dataset_and_to_policies_that_learn_from_it_alone(
    place, monkeypatch, capsys
):
    """In this process: no command of these has modules of one's own."""
    monkeypatch.chdir(place)
    page = "off_policy.md"
    run_train(*tiny(command(page, "train.py", "runs/expert"))[1:])
    recorded = command(page, "safe-rl evaluate", "record=true")
    assert main([word.replace("episodes=200", "episodes=40") for word in recorded[2:]]) == 0
    run_train(*tiny(command(page, "algo=sac_lagrangian", "dataset.alone=true"), fresh=True)[1:])
    assert "Learning from" in capsys.readouterr().out


def test_a_recurrent_policy_learns_from_a_replay_buffer(place):
    words = command("guides/observations.md", "my_memory.gru")
    carry_out([*words, "exploration.random_steps=200", "memory.batch_size=32"], place)
    assert (place / "runs/one/progress.csv").is_file()
