"""What PPO-Lagrangian comes to below limits of speed, from results/velocity/."""

from __future__ import annotations

from typing import NamedTuple

from algorithm_results import RESULTS, end_cells, finished_runs, last_quarter, spread

ARCHIVE = RESULTS / "velocity"
ALGORITHM, SEEDS = "ppo_lagrangian", (1321, 2201, 4420)


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


def velocity_runs() -> str:
    """The table."""
    rows = [
        "| `env=` | seeds | return | episode cost | epochs above 25 "
        "| OmniSafe after 10M steps: return | episode cost |",
        "|---|---|---|---|---|---|---|",
    ]
    for env, known in PUBLISHED.items():
        runs = finished_runs(ARCHIVE, ALGORITHM, env)
        ours = end_cells(last_quarter(runs[seed] for seed in SEEDS), 0)
        theirs = [spread(*known.episode_return, 0), spread(*known.cost, 1)]
        rows.append(f"| {' | '.join([f'`{env}`', str(len(SEEDS)), *ours, *theirs])} |")
    return "\n".join(rows)
