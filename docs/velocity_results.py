"""What PPO-Lagrangian comes to below limits of speed: the page made from results/velocity/."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from algorithm_results import RESULTS, end_cells, finished_runs, last_quarter, spread

from safe_rl.reporting.campaigns import PLAN, read_plan

ARCHIVE = RESULTS / "velocity"
MARK = "<!-- made by docs/generate_algorithms.py: change docs/velocity_results.py or results/ -->"


class Published(NamedTuple):
    """Mean and deviation of a return and of an episode cost, as they were published."""

    episode_return: tuple[float, float]
    cost: tuple[float, float]


# The columns "PPOLag" of Table 2 of OmniSafe's benchmarks/on-policy/README.md, commit 005e482.
PUBLISHED = {
    "SafeAntVelocity": Published((3261.87, 80.00), (12.05, 6.57)),
    "SafeHalfCheetahVelocity": Published((2946.15, 306.35), (3.44, 4.77)),
    "SafeHopperVelocity": Published((961.92, 752.87), (13.96, 19.33)),
    "SafeHumanoidVelocity": Published((6624.46, 25.9), (5.87, 9.46)),
    "SafeSwimmerVelocity": Published((64.74, 17.67), (28.02, 4.09)),
    "SafeWalker2dVelocity": Published((2982.27, 681.55), (13.49, 14.55)),
}
TEMPLATE = """# Velocity limits, measured

PPO-Lagrangian with its defaults and normalised observations, as OmniSafe has them, on
[Gymnasium's robots](suite.md#velocity-limits), limit 25, one million steps: means over the last
quarter million steps of training, ± the standard deviation among seeds. Beside them what OmniSafe
publishes of its PPO-Lagrangian (`PPOLag`), evaluated after **ten million** steps, also with a limit
of 25 ([table 2 of its
benchmark](https://github.com/PKU-Alignment/omnisafe/blob/main/benchmarks/on-policy/README.md), as
it stood at commit 005e482; ± as given there).

{table}

{missing}

A million steps are fifty updates of the default preset: robots that are hard to keep upright have
hardly begun to walk by then, and Hopper, whose episodes end early, has only begun to slow down.
Ten times the steps is one difference, another one the robots: ours are Gymnasium's of version 5,
those of Safety-Gymnasium, on which OmniSafe trains, of version 4, whose rewards differ for some of
them. Thresholds are the same. So compare orders of magnitude, and costs with the limit.

```
python train.py -m env=SafeHopperVelocity algo=ppo_lagrangian model.normalise=10 \\
    seed=300,301,302 frames=1_000_000
```

Observations are normalised because seed 300 without it had earned less on HalfCheetah and Hopper.
Tables of all epochs and the commits are in [`results/velocity/`](../../results/README.md).
"""


def velocity_page(archive: Path = ARCHIVE) -> str:
    """The page, of whatever runs there are."""
    rows = [
        "| `env=` | seeds | return | episode cost | epochs above 25 "
        "| OmniSafe, 10M steps: return | episode cost |",
        "|---|---|---|---|---|---|---|",
    ]
    missing = []
    for cell in read_plan(archive / PLAN):
        env = cell.chosen["env"]
        runs = finished_runs(archive, cell.chosen["algo"], env)
        parts = last_quarter(runs.values())
        ours = [str(len(parts)), *end_cells(parts, 0)] if parts else ["none yet", *"———"]
        rows.append(f"| `{env}` | {' | '.join([*ours, *_published(env)])} |")
        lacking = [str(seed) for seed in cell.seeds if seed not in runs]
        if lacking:
            missing.append(f"`{env}` ({', '.join(lacking)})")
    said = (
        f"Not run yet, or not to the end: {', '.join(missing)}."
        if missing
        else "All runs are done."
    )
    return f"{MARK}\n" + TEMPLATE.format(table="\n".join(rows), missing=said)


def _published(env: str) -> tuple[str, str]:
    if env not in PUBLISHED:
        return "not published", "not published"
    known = PUBLISHED[env]
    return spread(*known.episode_return, 0), spread(*known.cost, 1)
