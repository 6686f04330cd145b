"""What recipes build alike: the limits of a run, and the constraints that hold them."""

from __future__ import annotations

import torch
from omegaconf import DictConfig
from torchrl.envs import EnvBase

from safe_rl.algorithms.constraints import Constraints, check_cost_limits
from safe_rl.algorithms.parts import build_part
from safe_rl.algorithms.tracked_constraints import TrackedConstraints

__all__ = ["build_constraints", "constrained_limits"]


def constrained_limits(config: DictConfig, env: EnvBase, *, otherwise: str) -> dict[str, float]:
    """Limits of a constrained algorithm; one without constraints has none.

    Args:
        config: Configuration as composed from ``conf/``.
        env: Environment that has the costs.
        otherwise: Its like without constraints, for the message.

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


def build_constraints(
    config: DictConfig, limits: dict[str, float], max_length: int, device: torch.device
) -> Constraints:
    """Constraints with multiplier, tracker and risk measure as a configuration names them.

    Raises:
        ValueError: If a risk measure is named without a tracker.
    """
    multiplier = risk = None
    if config.get("lagrangian") is not None:
        multiplier = build_part(config.lagrangian, cost_limits=limits).to(device)
    values = torch.tensor(list(limits.values()))
    if limits and _names_a_part(config.get("risk")):
        risk = build_part(config.risk, cost_limits=values)
    if limits and _names_a_part(config.get("limits")):
        tracker = build_part(config.limits, cost_limits=values, max_length=max_length)
        return TrackedConstraints(
            limits, tracker=tracker, multiplier=multiplier, risk=risk, device=device
        )
    if risk is not None:
        raise ValueError(
            "risk: only the mean cost is limited by the episodes of a batch alone (limits=paper); "
            "other measures need limits=default."
        )
    return Constraints(limits, max_length=max_length, multiplier=multiplier, device=device)


def _names_a_part(node: DictConfig | None) -> bool:
    return node is not None and node.get("_target_") is not None
