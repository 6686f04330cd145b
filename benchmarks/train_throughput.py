"""Steps per second of whole training epochs, split into collecting and updating.

For comparison, the environment alone is stepped with random actions, with the same number of
environments and threads. All are timed in turns in one process; figures are medians over epochs.

    python benchmarks/train_throughput.py env=PointGoal1 algo=ppo_lagrangian
"""

import argparse
import statistics
import tempfile
import time
from pathlib import Path

from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from safe_rl.cli.config import give_limits
from safe_rl.envs import make_env, store_configs
from safe_rl.evaluation.loading import transforms_of
from safe_rl.files import CONF
from safe_rl.training.building import build_trainer, seed_everything


def compose_config(overrides):
    store_configs()
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose("config", overrides=[*overrides, "logger=none"])
    give_limits(config)
    return config


def new_env(config, evaluating=False):
    return make_env(
        OmegaConf.to_container(config.env, resolve=True),
        num_envs=config.num_envs,
        device=config.device,
        seed=config.seed,
        num_threads=config.num_threads or 0,
        transforms=transforms_of(config),
        evaluating=evaluating,
    )


def env_seconds(env, num_steps):
    """Seconds that the environment alone takes for `num_steps` vector steps."""
    tensordict = env.reset()
    actions = env.action_spec.rand((num_steps,))
    start = time.perf_counter()
    for action in actions:
        tensordict["action"] = action
        _, tensordict = env.step_and_maybe_reset(tensordict)
    return time.perf_counter() - start


def measure(config, epochs, directory):
    """Rows of one epoch each, the first left out, and the environment's seconds beside them."""
    seed_everything(config.seed, config.num_threads)
    trainer = build_trainer(config, new_env(config), directory)
    batches = iter(trainer.collector)
    env = new_env(config)
    num_steps = config.frames_per_batch // (config.num_envs * env.steps_per_decision)
    rows = []
    for _ in range(epochs + 1):
        rows.append(trainer.epoch(batches) | {"time_env": env_seconds(env, num_steps)})
    return rows[1:]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("overrides", nargs="*", help="as train.py takes them")
    parser.add_argument("--epochs", type=int, default=5)
    options = parser.parse_args()
    config = compose_config(options.overrides)
    with tempfile.TemporaryDirectory() as directory:
        rows = measure(config, options.epochs, Path(directory))
    frames = config.frames_per_batch
    seconds = {
        part: statistics.median(row[f"time_{part}"] for row in rows)
        for part in ("collect", "learn", "env")
    }
    epoch = statistics.median(row["time_collect"] + row["time_learn"] for row in rows)
    ratio = statistics.median(
        (row["time_collect"] + row["time_learn"]) / row["time_env"] for row in rows
    )
    print(f"{config.env.name} {config.algo.name}: {frames} steps an epoch, {config.num_envs} envs")
    print("| part | seconds an epoch | steps/s |\n|---|---|---|")
    for name, value in (
        ("collecting", seconds["collect"]),
        ("updating", seconds["learn"]),
        ("whole epoch", epoch),
        ("environment alone", seconds["env"]),
    ):
        print(f"| {name} | {value:.2f} | {frames / value:,.0f} |")
    print(f"epoch / environment alone: {ratio:.2f}")


if __name__ == "__main__":
    main()
