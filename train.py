"""Train an algorithm on an environment: ``python train.py env=PointGoal1 algo=ppo_lagrangian``."""

from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

import safe_rl.openmp  # noqa: F401, has to come before torch
from safe_rl.envs import make_env, store_configs
from safe_rl.training import build_trainer, seed_everything

store_configs()


@hydra.main(version_base="1.3", config_path="conf", config_name="config")
def main(config: DictConfig) -> None:
    """Compose, build, train."""
    seed_everything(config.seed, config.num_threads)
    env = make_env(
        OmegaConf.to_container(config.env, resolve=True),
        num_envs=config.num_envs,
        device=config.device,
        seed=config.seed,
        num_threads=config.num_threads or 0,
    )
    trainer = build_trainer(config, env, Path(HydraConfig.get().runtime.output_dir))
    print(trainer.run())


if __name__ == "__main__":
    main()
