"""From a resolved configuration to live objects: the only place that knows both.

Parts with a ``_target_`` (loss, multiplier, updates, advantage estimators) are built by
:func:`hydra.utils.instantiate`, so a configuration may name a class of its own.
"""

from __future__ import annotations

from collections.abc import Mapping
from difflib import get_close_matches
from typing import Any

import torch
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from torchrl.envs import EnvBase
from torchrl.objectives import LossModule

from safe_rl.algorithms.on_policy import Algorithm, Networks, mean_cost
from safe_rl.models import input_scale_vector, make_actor, make_critic
from safe_rl.objectives import CriticLoss
from safe_rl.objectives.multipliers import Multiplier

__all__ = ["build_algorithm", "build_networks", "check_cost_limits"]


def build_algorithm(config: DictConfig, env: EnvBase) -> Algorithm:
    """Build networks, estimators, losses and updates.

    Args:
        config: Configuration as composed from ``conf/``.
        env: Environment with ``observation_layout`` and ``cost_keys``.

    Raises:
        ValueError: If a cost limit names a cost that the environment does not have, or a
            constrained algorithm gets no limit.
    """
    limits = check_cost_limits(config.cost_limits, env.cost_keys)
    # without an estimator of cost advantages an algorithm has no constraints, whatever the limits
    is_constrained = config.get("cost_advantage") is not None
    constraints = limits if is_constrained else {}
    if is_constrained and not limits:
        raise ValueError(
            f"algo={config.algo.name} needs at least one entry in cost_limits, for example "
            "cost_limits='{cost: 25}'. Without constraints use algo=ppo."
        )
    device = torch.device(config.device)
    networks = build_networks(config.model, env, len(constraints), device)
    multiplier = None
    if config.get("lagrangian") is not None:
        multiplier = _build(config.lagrangian, cost_limits=constraints).to(device)
    cost_advantage = None
    if is_constrained:
        cost_advantage = _build(
            config.cost_advantage, cost_keys=list(constraints), value_network=networks.cost_critic
        )
    return Algorithm(
        networks=networks,
        cost_keys=list(constraints),
        cost_limits=torch.tensor(list(constraints.values()), dtype=torch.float32, device=device),
        cost_measure=instantiate(config.get("cost_measure")) or mean_cost,
        advantage=_build(config.advantage, value_network=networks.critic),
        cost_advantage=cost_advantage,
        multiplier=multiplier,
        policy_update=_build(
            config.policy_update, loss=_build_policy_loss(config.loss, networks, multiplier)
        ),
        critic_update=_build(
            config.critic_update, loss=CriticLoss(networks.critic, networks.cost_critic)
        ),
    )


def build_networks(
    model: DictConfig, env: EnvBase, num_costs: int, device: torch.device
) -> Networks:
    """Build the actor, the reward critic and, for ``num_costs`` > 0, the cost critic."""
    observation_size = env.observation_spec["observation"].shape[-1]
    common: dict[str, Any] = {
        "hidden_sizes": list(model.hidden_sizes),
        "input_scale": input_scale_vector(model.input_scale, env.observation_layout),
        "device": device,
    }
    actor = make_actor(
        observation_size,
        env.action_spec.shape[-1],
        initial_log_std=model.initial_log_std,
        **common,
    )
    critic = make_critic(observation_size, **common)
    cost_critic = None
    if num_costs:
        cost_critic = make_critic(
            observation_size, num_outputs=num_costs, out_key="cost_value", **common
        )
    return Networks(actor, critic, cost_critic)


def check_cost_limits(cost_limits: Mapping[str, float], cost_keys: list[str]) -> dict[str, float]:
    """Return the limits as a plain dictionary, once every key is known to the environment.

    Raises:
        ValueError: If a key is unknown, or a limit is negative or not a number.
    """
    limits: dict[str, float] = {}
    for key, limit in cost_limits.items():
        if key not in cost_keys:
            close = get_close_matches(key, cost_keys, n=1, cutoff=0.8)
            nearest = f" Nearest: '{close[0]}'." if close else ""
            raise ValueError(
                f"cost_limits names '{key}', but this environment has no such cost.{nearest} It "
                f"has {', '.join(cost_keys)}; env.constrain_<kind>=true adds those of another kind."
            )
        if isinstance(limit, bool) or not isinstance(limit, int | float) or not limit >= 0:
            raise ValueError(
                f"The limit of '{key}' is {limit!r}: it must be a number of at least 0, the "
                "undiscounted cost allowed per episode."
            )
        limits[key] = float(limit)
    return limits


def _build_policy_loss(
    loss: DictConfig, networks: Networks, multiplier: Multiplier | None
) -> LossModule:
    """Lagrangian losses get the multiplier besides the actor."""
    weights = {} if multiplier is None else {"multiplier": multiplier}
    return _build(loss, actor_network=networks.actor, **weights)


def _build(node: DictConfig, **objects: Any) -> Any:
    """Instantiate ``node`` with live objects, which Hydra would copy if it got them itself."""
    OmegaConf.resolve(node)
    try:
        return instantiate(node, _partial_=True)(**objects)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{node._get_full_key(None)}: {error}") from error
