"""Train an algorithm on an environment: ``python train.py env=PointGoal1 algo=ppo_lagrangian``."""

import hydra
from omegaconf import DictConfig

from safe_rl.cli.train import job, start


@hydra.main(config_path="conf", config_name="config", version_base="1.3")
def main(config: DictConfig) -> float | None:
    """Begin or continue the run of a configuration."""
    return job(config)


if __name__ == "__main__":
    start(main)
