"""Build the parts of an algorithm, and its constraints, from nodes of a configuration.

Parts with a ``_target_`` (losses, multipliers, updates, advantage estimators) may be classes of
your own. A constructor gets the objects of the run, such as ``actor_network``, by their names.
"""

from __future__ import annotations

import math
from inspect import isclass
from typing import Any, TypeVar

import torch
from omegaconf import DictConfig
from torchrl.envs import EnvBase
from torchrl.objectives import LossModule

from safe_rl.algorithms.algorithm_contract import Recipe
from safe_rl.algorithms.constraints import Constraints, TrackedConstraints, check_cost_limits
from safe_rl.objectives import Multiplier
from safe_rl.parameters import accepted_names, required_names
from safe_rl.targets import TargetError, build, locate

Part = TypeVar("Part")

_DEFAULT_RECIPE = "safe_rl.algorithms.OnPolicy"


def find_recipe(config: DictConfig) -> type[Recipe]:
    """The recipe that a configuration names as ``algo._target_``; by default `OnPolicy`.

    Raises:
        TargetError: If there is no such class, or it is not a recipe.
    """
    target = config.algo.get("_target_", _DEFAULT_RECIPE)
    recipe = locate(target, "algo._target_")
    if not (isclass(recipe) and issubclass(recipe, Recipe)):
        raise TargetError(
            f"algo._target_={target} is no recipe: derive it from safe_rl.algorithms.Recipe."
        )
    return recipe


def build_part(node: DictConfig, **objects: Any) -> Any:
    """Build the object that a node names, from the node's settings and objects of the run.

    Its constructor gets those of the `objects` that are among its arguments and are not None.

    Raises:
        TargetError: If the target may not be built, or if building it fails.
    """
    target = locate(node.get("_target_"), f"{node._get_full_key(None)}._target_")
    names = accepted_names(target)
    has_none = "multiplier" in objects and objects["multiplier"] is None
    if has_none and "multiplier" in required_names(target):
        raise TargetError(
            f"{node._get_full_key(None)}._target_={node._target_} needs a multiplier, and the "
            "algorithm has none: add '- /lagrangian: ${preset}' to the defaults of its YAML file."
        )
    return build(node, **{k: v for k, v in objects.items() if v is not None and k in names})


def build_update(node: DictConfig, kind: type[Part], **objects: Any) -> Part:
    """Build an update of networks, as `build_part` does.

    Raises:
        TargetError: As in `build_part`, or if the result is not an update of this kind.
    """
    return _of_kind(build_part(node, **objects), kind, node, "update", "safe_rl.algorithms")


def build_loss(node: DictConfig, **objects: Any) -> LossModule:
    """Build a loss, as `build_part` does.

    Raises:
        TargetError: As in `build_part`, or if the result is not a loss module.
    """
    return _of_kind(build_part(node, **objects), LossModule, node, "loss", "torchrl.objectives")


def _of_kind(part: Any, kind: type[Part], node: DictConfig, name: str, home: str) -> Part:
    if not isinstance(part, kind):
        raise TargetError(
            f"{node._get_full_key(None)}._target_={node._target_} is no {name}: derive it from "
            f"{home}.{kind.__name__}."
        )
    return part


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


def build_constraints(
    config: DictConfig, limits: dict[str, float], env: EnvBase, device: torch.device
) -> Constraints:
    """Constraints with the multiplier, tracker and risk measure that a configuration names.

    Lengths of episodes are in decisions (time steps of a batch), schedules in environment steps.

    Raises:
        TargetError: If the multiplier is not a `Multiplier`.
        ValueError: If a risk measure is named without a tracker.
    """
    multiplier = risk = None
    per_decision = env.steps_per_decision
    max_length = math.ceil(env.max_episode_steps / per_decision)
    if config.get("lagrangian") is not None:
        node = config.lagrangian
        built = build_part(node, cost_limits=limits)
        multiplier = _of_kind(built, Multiplier, node, "multiplier", "safe_rl.objectives")
        multiplier = multiplier.to(device)
    values = torch.tensor(list(limits.values()))
    if limits and _names_a_part(config.get("risk")):
        risk = build_part(config.risk, cost_limits=values, steps_per_decision=per_decision)
    if limits and _names_a_part(config.get("limits")):
        tracker = build_part(
            config.limits,
            cost_limits=values,
            max_length=max_length,
            steps_per_decision=per_decision,
        )
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
