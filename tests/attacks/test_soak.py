"""A long run takes no more memory than a short one."""

import os
from pathlib import Path

import pytest
from attacking import SCALE
from point_mass import PointMass
from run_configs import off_policy_config, point_mass_config

from safe_rl.training.building import build_trainer, seed_everything


def resident():
    """Resident memory of this process [bytes]."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


@pytest.mark.parametrize("kind", ["on-policy", "off-policy"])
def test_memory_is_flat_over_a_million_steps(kind, tmp_path):
    frames = round(max(SCALE, 0.2) * 100) * 10_000
    sizes = [f"frames={frames}", "num_envs=100", "frames_per_batch=10_000"]
    sizes += ["checkpoint.interval=2"]
    if kind == "on-policy":
        sizes += ["policy_update.num_passes=1", "critic_update.num_passes=1"]
        sizes += ["critic_update.minibatch_size=2000"]
        config = point_mass_config(*sizes, minibatch_size=2000)
    else:
        sizes += ["memory.capacity=50_000", "policy_update.updates_per_step=0.0002"]
        config = off_policy_config("algo=sac_lagrangian", *sizes)
    seed_everything(0, 1)
    trainer = build_trainer(config, PointMass(100, 20), tmp_path)
    found = []
    trainer.callbacks = [lambda row: found.append(resident())]
    trainer.run()
    assert len(found) >= 20
    # the first tenth fills caches and the replay buffer
    grown = max(found[-5:]) - max(found[5 : len(found) // 3 + 5])
    assert grown < 30e6, f"{grown / 1e6:.0f} MB more at the end"
