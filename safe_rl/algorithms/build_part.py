"""What every algorithm needs from a configuration: its class, its limits and its constraints."""

from __future__ import annotations

import math
from inspect import isclass

import torch
from omegaconf import DictConfig
from torchrl.envs import EnvBase

from safe_rl.algorithms.algorithm_contract import Algorithm
from safe_rl.algorithms.constraints import Constraints, check_cost_limits
from safe_rl.objectives import Multiplier
from safe_rl.trust import TargetError, instantiate, locate

_DEFAULT = "safe_rl.algorithms.OnPolicy"


def find_algorithm(config: DictConfig) -> type[Algorithm]:
    """The class that a configuration names as ``algo._target_``; by default `OnPolicy`.

    Raises:
        TargetError: If there is no such class, or it is not an algorithm.
    """
    target = config.algo.get("_target_", _DEFAULT)
    algorithm = locate(target, "algo._target_")
    if not (isclass(algorithm) and issubclass(algorithm, Algorithm)):
        raise TargetError(
            f"algo._target_={target} is no algorithm: derive it from safe_rl.algorithms.Algorithm."
        )
    return algorithm


def constrained_limits(config: DictConfig, env: EnvBase, *, otherwise: str) -> dict[str, float]:
    """Cost limits of the configuration's algorithm; empty if it is unconstrained.

    Args:
        config: Configuration as composed from ``conf/``.
        env: Environment that has the costs.
        otherwise: Name of a similar algorithm without constraints, for the error message.

    Raises:
        ValueError: If a limit names no cost of the environment, a constrained algorithm has no
            limit, or the configuration does not say whether it is constrained.
    """
    limits = check_cost_limits(config.cost_limits, env.cost_keys)
    if config.algo.get("constrained") is None:
        raise ValueError(
            f"algo.constrained is missing: the YAML file of algo={config.algo.name} says true if "
            "it keeps cost_limits, and false if it only counts costs."
        )
    if not config.algo.constrained:
        return {}
    if not limits:
        raise ValueError(
            f"algo={config.algo.name} needs at least one entry in cost_limits, for example "
            f"cost_limits='{{cost: 25}}'. Without constraints use algo={otherwise}."
        )
    return limits


def build_multiplier(
    config: DictConfig, limits: dict[str, float], device: torch.device
) -> Multiplier | None:
    """The multiplier that a configuration names, or None."""
    multiplier = instantiate(config.get("lagrangian"), cost_limits=limits)
    return None if multiplier is None else multiplier.to(device)


def build_constraints(
    config: DictConfig, limits: dict[str, float], env: EnvBase, device: torch.device
) -> Constraints:
    """Constraints with the tracker and risk measure that a configuration names.

    Lengths of episodes are in decisions (time steps of a batch), schedules in environment steps.

    Raises:
        ValueError: If a risk measure is named without a tracker.
    """
    max_length = math.ceil(env.max_episode_steps / env.steps_per_decision)
    if not limits:
        return Constraints({}, max_length=max_length, device=device)
    values = torch.tensor(list(limits.values()))
    known = {"steps_per_decision": env.steps_per_decision, "max_length": max_length}
    risk = instantiate(config.get("risk"), known, cost_limits=values)
    tracker = instantiate(config.get("limits"), known, cost_limits=values)
    if risk is not None and tracker is None:
        raise ValueError(
            "risk: only the mean cost is limited by the episodes of a batch alone (limits=null); "
            "other measures need limits, as in conf/algo/cpo.yaml."
        )
    return Constraints(limits, max_length=max_length, tracker=tracker, risk=risk, device=device)
