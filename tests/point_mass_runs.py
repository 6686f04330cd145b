"""Trainers of runs on the point mass that take a second."""

from pathlib import Path
from typing import Any

from omegaconf import DictConfig
from point_mass import PointMass
from run_configs import point_mass_config

from safe_rl.training.building import build_trainer, seed_everything
from safe_rl.training.trainer import Trainer


def trainer_of(
    config: DictConfig, directory: Path, env: PointMass | None = None, **options: Any
) -> Trainer:
    """What the command line builds for a configuration, on another environment if one is given."""
    seed_everything(config.seed, 1)
    env = PointMass(config.num_envs, 20, config.seed) if env is None else env
    return build_trainer(config, env, directory, **options)


def point_mass_trainer(
    directory: Path, *overrides: str, num_steps: int = 20, minibatch_size: int | None = 80
) -> Trainer:
    """That of `point_mass_config`, with episodes of so many steps."""
    config = point_mass_config(*overrides, minibatch_size=minibatch_size)
    return trainer_of(config, directory, PointMass(config.num_envs, num_steps, config.seed))
