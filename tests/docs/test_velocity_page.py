"""The table of velocity limits is that of the archived runs."""

import re

import numpy as np
import pytest
from velocity_tables import ARCHIVE, SEEDS, velocity_runs

from safe_rl.envs.velocity import VELOCITY_SUITE
from safe_rl.reporting.archive import read_archive


@pytest.mark.parametrize("env", VELOCITY_SUITE)
def test_runs_are_averaged_over_the_last_quarter(env):
    means = []
    for seed in SEEDS:
        table = read_archive(ARCHIVE)[f"{env}/ppo_lagrangian/seed{seed}"].table
        late = np.array(table["steps"]) > 750_000
        returns, costs = (np.array(table[f"episode_{key}"])[late] for key in ("return", "cost"))
        means.append((returns.mean(), costs.mean(), (costs > 25).mean()))
    (mean, cost, above), (spread, cost_spread, _) = np.mean(means, 0), np.std(means, 0, ddof=1)
    cells = f"3 | {mean:.0f} ± {spread:.0f} | {cost:.1f} ± {cost_spread:.1f} | {above:.0%} |"
    assert re.search(rf"^\| `{env}` \| {re.escape(cells)}", velocity_runs(), re.MULTILINE)
