"""Which runs slates of environments still lack, and the commands that make them."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping, Sequence

from safe_rl.reporting.columns import Column, Table
from safe_rl.reporting.experiments import Experiment
from safe_rl.reporting.slate_scores import can_be_normalised
from safe_rl.runs.identity import Role, role_of
from safe_rl.scores.published import SEEDS
from safe_rl.scores.slates import SLATES

__all__ = ["lacking_table", "missing_seeds"]

# groups that a command for missing runs chooses itself
_CHOSEN = {"env", "algo", "slate", "init_from", "hydra"}


def missing_seeds(
    slate: str, algorithm: str, experiments: Sequence[Experiment], needed: int
) -> dict[str, tuple[int, ...]]:
    """Environment of a slate -> seeds that an algorithm still lacks on it.

    The published seeds come first, then further multiples of ten.
    """
    done = {
        e.benchmark: {run.seed for run in e.finished}
        for e in experiments
        if e.algorithm == algorithm and can_be_normalised(e)
    }
    missing = {}
    for environment in SLATES[slate]:
        own = done.get(environment, set())
        further = range(max(SEEDS) + 10, max(SEEDS) + 10 * (needed + len(own) + 1), 10)
        left = [seed for seed in (*SEEDS, *further) if seed not in own]
        if len(own) < needed:
            missing[environment] = tuple(left[: needed - len(own)])
    return missing


def lacking_table(experiments: Sequence[Experiment], needed: int) -> Table:
    """What slates lack of algorithms with runs on a third of their environments, and commands."""
    records = []
    afresh = [e for e in experiments if not e.is_continued]
    for slate, environments in SLATES.items():
        begun = [e for e in afresh if e.benchmark in environments]
        for algorithm in dict.fromkeys(e.algorithm for e in begun):
            own = [e for e in begun if e.algorithm == algorithm]
            missing = missing_seeds(slate, algorithm, experiments, needed)
            if missing and 3 * len({e.benchmark for e in own}) >= len(environments):
                records.append(
                    {
                        "slate": slate,
                        "algorithm": algorithm,
                        "runs": sum(map(len, missing.values())),
                        "commands": "\n".join(_commands(own, missing)) or "not recorded",
                    }
                )
    columns = [Column(name) for name in ("slate", "algorithm")]
    columns += [Column("runs", ("{:d}", "runs")), Column("commands")]
    note = "Slates of which an algorithm has runs on less than a third are not listed."
    return Table("missing", "What slates still lack", columns, records, note)


def _commands(
    experiments: Sequence[Experiment], missing: Mapping[str, tuple[int, ...]]
) -> Iterator[str]:
    """Command lines for missing runs: a sweep for every set of seeds; none if none is recorded."""
    known = [run for e in experiments for run in e.runs if run.overrides is not None]
    if not known:
        return
    run = known[0]
    kept = [override for override in run.overrides or () if _is_of_the_algorithm(override)]
    for seeds in dict.fromkeys(missing.values()):
        environments = ",".join(name for name, own in missing.items() if own == seeds)
        words = ["python", "train.py", "-m", f"env={environments}", f"algo={run.algorithm}", *kept]
        yield shlex.join([*words, f"seed={','.join(map(str, seeds))}"])


def _is_of_the_algorithm(override: str) -> bool:
    """Whether it may change results: the way in which environments are stepped may, too."""
    key = override.lstrip("+~").partition("=")[0]
    group = key.partition(".")[0].partition("@")[0]
    if group == "import":
        return True
    return group not in _CHOSEN and role_of(key) not in (Role.SEED, Role.MACHINE)
