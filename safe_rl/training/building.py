"""From a configuration and an environment to a run that is ready to begin."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import torch
from omegaconf import DictConfig
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import Collector
from torchrl.envs import EnvBase

from safe_rl.algorithms.constraints import check_cost_limits
from safe_rl.algorithms.contract import Algorithm
from safe_rl.algorithms.parts import find_recipe
from safe_rl.collectors import Recording, WorkerCollector, make_collector
from safe_rl.collectors.worker_rows import MakeEnv
from safe_rl.runs.record import RunRecord
from safe_rl.targets import build
from safe_rl.training.trainer import Evaluator, Trainer

__all__ = ["build_trainer", "physics_threads", "seed_everything"]

MakeEvaluation = Callable[[TensorDictModuleBase], Evaluator]
"""Makes an evaluation of a policy that goes on learning."""


def physics_threads(config: DictConfig) -> int:
    """Threads that step each environment; 0 is one per core. Workers share them."""
    num_collectors = config.collector.num_collectors
    if num_collectors == 1:
        return config.num_threads or 0
    return max(1, (config.num_threads or os.cpu_count() or 1) // num_collectors)


def seed_everything(seed: int, num_threads: int | None) -> None:
    """Seed torch and set the number of threads it computes with; None leaves the number alone."""
    torch.manual_seed(seed)
    if num_threads is not None:
        torch.set_num_threads(num_threads)


def build_trainer(
    config: DictConfig,
    env: EnvBase,
    directory: Path,
    make_env: MakeEnv | None = None,
    make_evaluation: MakeEvaluation | None = None,
) -> Trainer:
    """Build everything that a run consists of.

    Args:
        config: Configuration as composed from ``conf/``.
        env: Seeded environment that keeps the contract of `safe_rl.envs`; if it has ``get_state``
            and ``set_state``, a checkpoint holds the state of its worlds.
        directory: Folder of the run.
        make_env: Makes an environment like ``env`` with another ``num_envs``, for collectors with
            workers.
        make_evaluation: Makes, of the policy, what evaluates it in between.

    Raises:
        ValueError: If parts of the configuration do not fit together.
    """
    cost_limits = check_cost_limits(config.cost_limits, env.cost_keys)
    algorithm = find_recipe(config).build(config, env)
    record = RunRecord(directory, config, cost_limits, env.max_episode_steps)
    recording = Recording(record.folder.transitions, env.cost_keys)
    return Trainer(
        env=env,
        algorithm=algorithm,
        collector=_build_collector(config, env, make_env, algorithm),
        cost_limits=cost_limits,
        record=record,
        config=config,
        evaluation=None if make_evaluation is None else make_evaluation(algorithm.policy),
        recording=recording if config.get("record") else None,
    )


def _build_collector(
    config: DictConfig, env: EnvBase, make_env: MakeEnv | None, algorithm: Algorithm
) -> Collector | WorkerCollector:
    policy = algorithm.policy
    numbers = {"frames_per_batch": config.frames_per_batch, "device": config.device}
    if config.collector.get("_target_") is None:
        return make_collector(env, policy, **numbers)
    return build(config.collector, env=env, make_env=make_env, policy=policy, **numbers)
