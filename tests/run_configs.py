"""Configurations composed as the command line composes them, for tests without it."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from omegaconf import DictConfig, OmegaConf

import safe_rl.cli.config  # noqa: F401, Hydra's ConfigStore gets the general keys
from safe_rl.cli.config import give_limits
from safe_rl.envs import store_configs
from safe_rl.files import CONF

store_configs()

# what the benchmark's environments have and the point mass lacks, a configuration by name
ConfigStore.instance().store(
    group="env", name="PointMass", node={"name": "PointMass", "robot_base": "point"}
)


def nodes(node: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Full paths of a configuration's mappings, from outside to inside."""
    for key, value in node.items():
        if OmegaConf.is_dict(value) and key != "env":
            yield f"{path}{key}", value
            yield from nodes(value, f"{path}{key}.")


def compose_config(*overrides: str) -> DictConfig:
    """Compose ``conf/config.yaml`` with command-line overrides."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose("config", overrides=list(overrides))
    give_limits(config)
    return config


def point_mass_config(*overrides: str, minibatch_size: int | None = 80) -> DictConfig:
    """A run on the point mass that takes a second: 8 epochs of 4 x 40 steps.

    ``minibatch_size=None`` leaves a policy update alone that knows no minibatches.
    """
    minibatches = [f"policy_update.minibatch_size={minibatch_size}", "policy_update.num_passes=2"]
    return compose_config(
        "env=PointMass",
        "frames=1280",
        "num_envs=4",
        "frames_per_batch=160",
        "model.hidden_sizes=[16]",
        *(minibatches if minibatch_size else []),
        "critic_update.minibatch_size=80",
        "critic_update.num_passes=2",
        "logger=none",
        *overrides,
    )


def off_policy_config(*overrides: str) -> DictConfig:
    """A run with a replay buffer: 8 epochs of 4 x 40 steps, 8 gradient steps after each."""
    return compose_config(
        *("env=PointMass", "frames=1280", "num_envs=4", "frames_per_batch=160", "logger=none"),
        *("model.hidden_sizes=[16]", "memory.batch_size=32", "exploration.random_steps=160"),
        *("policy_update.updates_per_step=0.05", "memory.keep=true", "memory.n_steps=1"),
        *overrides,
    )


def without_times(path: Path) -> list[list[str]]:
    """Rows of a run's table without its columns of times."""
    lines = [line.split(",") for line in path.read_text().splitlines()]
    times = {i for i, name in enumerate(lines[0]) if "time" in name or name == "steps_per_second"}
    assert len(times) == 4
    return [[field for i, field in enumerate(line) if i not in times] for line in lines]


def assert_resumes_exactly(make: Callable[..., Any], folder: Path, *half: str) -> Any:
    """Compare the tables of a run that is interrupted and of one that is not.

    `make(name, *overrides)` makes a trainer of a run in ``folder / name``; `half` are overrides of
    the first part alone. Returns the resumed trainer.
    """
    make("whole").run()
    make("halves", *half).run()
    torch.rand(7)
    resumed = make("halves")
    assert resumed.resume()
    resumed.run()
    table, expected = (without_times(folder / n / "progress.csv") for n in ("halves", "whole"))
    assert len(expected) > 2
    assert table == expected
    return resumed
