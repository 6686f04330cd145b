"""Build a run from a configuration and an environment.

A run can start from the networks of another run (Ray, Achiam, Amodei 2019, section 6).
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig
from tensordict.nn import TensorDictModuleBase
from torchrl.checkpoint import CheckpointError
from torchrl.collectors import Collector
from torchrl.envs import EnvBase

from safe_rl.algorithms.algorithm_contract import Algorithm, find_algorithm
from safe_rl.algorithms.constraints import check_cost_limits
from safe_rl.collectors import Recording, WorkerCollector, make_collector
from safe_rl.collectors.building import check_batch
from safe_rl.collectors.workers import MakeEnv
from safe_rl.envs import make_env
from safe_rl.evaluation.episodes import default_seed, has_fixed_layout, periodic_evaluation
from safe_rl.evaluation.loading import robot_of, transforms_of
from safe_rl.runs.checkpoints import CheckpointStore, check_interface, read_facts
from safe_rl.runs.folder import run_of
from safe_rl.runs.run import Run
from safe_rl.runs.writing import RunWriter
from safe_rl.training.trainer import Evaluator, Trainer
from safe_rl.trust import allow, allowed, instantiate

MakeEvaluation = Callable[[TensorDictModuleBase], Evaluator]
"""Makes the periodic evaluation of a policy that is trained."""


def seed_everything(seed: int, num_threads: int | None) -> None:
    """Seed torch and set the number of threads it computes with; None leaves the number alone."""
    torch.manual_seed(seed)
    if num_threads is not None:
        torch.set_num_threads(num_threads)


def build_run(config: DictConfig, run: Run) -> Trainer:
    """Build all parts of a run, with its environments and periodic evaluations."""
    node, num_collectors = robot_of(run, config.env), config.collector.num_collectors
    num_threads = config.num_threads or 0  # of physics; 0: one per core
    if num_collectors > 1:
        num_threads = max(1, (num_threads or os.cpu_count() or 1) // num_collectors)
    make = partial(
        make_env,
        node,
        device=config.device,
        seed=config.seed,
        num_threads=num_threads,
        transforms=transforms_of(config),
    )
    in_workers = partial(_make_after_imports, allowed(), list(sys.path), make)
    env = make(num_envs=config.num_envs)
    evaluation, periodic = None, config.get("evaluation")
    if periodic is not None:
        evaluation = partial(
            periodic_evaluation,
            partial(make, evaluating=True),
            cost_keys=env.cost_keys,
            seed=default_seed(node, config.seed),
            fixed_layout=has_fixed_layout(node),
            interval=periodic.interval,
            episodes=periodic.episodes,
        )
    return build_trainer(config, env, run.directory, in_workers, evaluation)


def _make_after_imports(
    modules: Sequence[str], path: list[str], make: MakeEnv, **options: Any
) -> EnvBase:
    """Make environments in a worker process, which imports the user's modules first."""
    sys.path[:] = path
    for name in modules:
        import_module(name)
        allow(name)
    return make(**options)


def build_trainer(
    config: DictConfig,
    env: EnvBase,
    directory: Path,
    make_env: MakeEnv | None = None,
    make_evaluation: MakeEvaluation | None = None,
) -> Trainer:
    """Build the parts of a run for an environment.

    Args:
        config: Configuration as composed from ``conf/``.
        env: Seeded environment that fulfils the contract of `safe_rl.envs`. If its ``get_state``
            returns a state, checkpoints have it.
        directory: Folder of the run.
        make_env: Makes an environment like ``env`` with another ``num_envs``, for workers.
        make_evaluation: Makes the periodic evaluation of the policy; None: there is none.
    """
    cost_limits = check_cost_limits(config.cost_limits, env.cost_keys)
    algorithm = find_algorithm(config).from_config(config, env)
    writer = RunWriter(Run(directory), config, cost_limits, env.max_episode_steps)
    recording = None
    if config.get("record"):
        known = {"interface": env.interface, "is_privileged": bool(env.privileged_layout)}
        recording = Recording(writer.run.transitions_folder, env.cost_keys, **known)
    return Trainer(
        env=env,
        algorithm=algorithm,
        collector=_build_collector(config, env, make_env, algorithm),
        writer=writer,
        evaluation=None if make_evaluation is None else make_evaluation(algorithm.policy),
        recording=recording,
    )


def _build_collector(
    config: DictConfig, env: EnvBase, make_env: MakeEnv | None, algorithm: Algorithm
) -> Collector | WorkerCollector:
    num_envs, held = env.batch_size.numel(), env.steps_per_decision
    check_batch(config.frames_per_batch, num_envs, held)
    decisions = config.frames_per_batch // held
    given = {"policy": algorithm.policy, "frames_per_batch": decisions, "device": config.device}
    if config.collector.get("_target_") is None:
        return make_collector(env, **given)
    return instantiate(config.collector, env=env, make_env=make_env, **given)


def _other_actions(known: Any, here: Mapping[str, Any]) -> Iterator[str]:
    """Warnings if actions meant something else where a policy was trained, by two `interface`s."""
    key, known = "steps_per_decision", known if isinstance(known, dict) else {}
    if known.get(key, here[key]) != here[key]:
        yield f"Warning: an action of init_from lasts {known[key]} step(s), and here {here[key]}."
    both = (known.get("actions"), here["actions"])
    bounds = [[a.get("own_low"), a.get("own_high")] for a in both if isinstance(a, dict)]
    if len(bounds) == 2 and bounds[0] != bounds[1]:
        yield f"Warning: actions of init_from have the bounds {bounds[0]}, and here {bounds[1]}."


def begin_from(
    algorithm: Algorithm, config: Mapping[str, Any], interface: Mapping[str, Any] | None = None
) -> list[str]:
    """Load the trained weights of the run that ``init_from`` names into an algorithm's networks.

    Optimisers, multipliers and counters start anew. Cost networks get the other run's weights only
    if that run had the same constrained costs, the same risk measure and, with Q functions, the
    same loss. The names of the networks that were loaded are returned.

    Args:
        algorithm: The algorithm of the new run.
        config: Its configuration. ``init_from`` is a checkpoint, or the folder of a run, whose
            newest checkpoint is read.
        interface: ``interface`` of the new run's environment; None: it is not compared.

    Raises:
        CheckpointError: If there is no checkpoint, it lacks a network, or its networks have other
            shapes or were trained on other observations.
    """
    source = Path(config["init_from"]).expanduser()
    if not source.exists():
        raise CheckpointError(f"init_from={source}: there is no such folder or file.")
    checkpoint = Run(source).newest_checkpoint() if source.is_dir() else source
    if checkpoint is None:
        raise CheckpointError(
            f"init_from={source}: there is no checkpoint. Give the folder of a run, or a file in "
            "its folder 'checkpoints'."
        )
    if interface is not None:
        check_interface(checkpoint, interface)
        for warning in _other_actions(read_facts(checkpoint).get("interface"), interface):
            print(warning)
    run = Run(run_of(checkpoint)[0])
    same_costs = estimated(config) == estimated(run.settings if run.is_run else {})
    taken = {
        name: network
        for name, network in algorithm.networks.items()
        if same_costs or name not in algorithm.cost_networks
    }
    try:
        CheckpointStore.load(checkpoint, taken)
    except CheckpointError as error:
        raise CheckpointError(
            f"{error} init_from needs a run that has trained all networks of this one (algo=bc and "
            "exported policies have only the actor), with the same observations, actions and kind "
            "of algorithm (on-policy, SAC or TD3). Set model.… and critics.… as in its config.yaml."
        ) from error
    algorithm.networks_replaced()
    return list(taken)


def estimated(config: Mapping[str, Any]) -> tuple[Any, ...]:
    """What decides what cost critics estimate: costs, risk, and the loss of Q functions."""
    is_constrained = (config.get("algo") or {}).get("constrained") is not False
    has_q_functions = isinstance(config.get("critics"), Mapping)
    risk = config.get("risk") or {}
    # with risk=mean the section may still have numbers
    read = ("_target_", "tail", "most_over") if risk.get("_target_") else ()
    return (
        list(config.get("cost_limits") or ()) if is_constrained else [],
        {key: risk.get(key) for key in read},
        (config.get("loss") or {}).get("_target_") if has_q_functions else None,
    )
