"""Train an algorithm on an environment: ``python train.py env=PointGoal1 algo=ppo_lagrangian``."""

import sys
from functools import partial
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

import safe_rl.openmp  # noqa: F401, has to come before torch
from safe_rl.command_line import CommandLineError, check_env_keys, expand_arguments
from safe_rl.envs import SafetyGymConfig, make_env, store_configs
from safe_rl.resuming import is_finished, may_continue
from safe_rl.training import build_trainer, physics_threads, seed_everything
from safe_rl.transfer import initialise_networks

store_configs()


@hydra.main(version_base="1.3", config_path="conf", config_name="config")
def main(config: DictConfig) -> None:
    """Compose, build, train."""
    directory = Path(HydraConfig.get().runtime.output_dir)
    continues = may_continue(HydraConfig.get(), config)
    if continues and is_finished(directory, config.frames):
        print(f"{directory} has its {config.frames:,} frames already: raise 'frames' to train on.")
        return
    seed_everything(config.seed, config.num_threads)
    make = partial(
        make_env,
        OmegaConf.to_container(config.env, resolve=True),
        device=config.device,
        seed=config.seed,
        num_threads=physics_threads(config),
    )
    trainer = build_trainer(config, make(num_envs=config.num_envs), directory, make)
    if continues and trainer.resume():
        print(f"Going on after {trainer.progress.steps:,} of {config.frames:,} frames.")
    elif config.init_from is not None:
        algorithm = trainer.algorithm
        initialise_networks(algorithm.networks, Path(config.init_from), algorithm.cost_keys)
    print(trainer.run())
    if trainer.interrupted_by is not None:
        print(f"Interrupted. Continue with: python train.py resume={directory}")
        raise SystemExit(128 + trainer.interrupted_by)


if __name__ == "__main__":
    try:
        check_env_keys(sys.argv[1:], {"name", *SafetyGymConfig().to_dict()})
        sys.argv[1:] = expand_arguments(sys.argv[1:])
    except CommandLineError as error:
        raise SystemExit(str(error)) from None
    main()
