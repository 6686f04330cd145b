"""Trainers of runs on the point mass that take a second."""

from pathlib import Path

from point_mass import PointMass
from run_configs import point_mass_config

from safe_rl.training.building import build_trainer, seed_everything
from safe_rl.training.trainer import Trainer


def point_mass_trainer(
    directory: Path, *overrides: str, num_steps: int = 20, minibatch_size: int | None = 40
) -> Trainer:
    """What the command line builds for `point_mass_config`, with episodes of so many steps."""
    config = point_mass_config(*overrides, minibatch_size=minibatch_size)
    seed_everything(config.seed, 1)
    return build_trainer(config, PointMass(config.num_envs, num_steps, config.seed), directory)
