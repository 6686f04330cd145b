"""Networks of off-policy algorithms, as a configuration describes them."""

from __future__ import annotations

from typing import Any

import torch
from omegaconf import DictConfig
from tensordict.nn import TensorDictModuleBase
from torchrl.data import Bounded, TensorSpec
from torchrl.envs import EnvBase

from safe_rl.models import ExploringPolicy, QEnsemble, input_scale_vector
from safe_rl.models.encoders import TO_FLATTEN, observed_entries
from safe_rl.objectives import CostValues, MeanCosts
from safe_rl.trust import instantiate

_ON_POLICY_ONLY = ("_target_", "encoders", "memory", "normalise")


def bounded_actions(env: EnvBase) -> TensorSpec:
    """Spec of one environment's bounded action, [A], in single precision like the networks.

    Raises:
        ValueError: If actions are not vectors [A] of continuous numbers within finite bounds.
    """
    spec = env.action_spec_unbatched
    is_continuous = isinstance(spec, Bounded) and spec.dtype.is_floating_point
    if not is_continuous or not (spec.low.isfinite() & spec.high.isfinite()).all():
        raise ValueError(
            "Off-policy algorithms need continuous actions within bounds, and this environment's "
            f"action_spec is {type(spec).__name__}. Use an on-policy one such as ppo_lagrangian."
        )
    if len(spec.shape) != 1:
        raise ValueError(
            f"An action of this environment has the shape {list(spec.shape)}: policies act by "
            "vectors [A]. Let the environment take them, and give them their shape itself."
        )
    return spec.to(torch.float32)


def exploring(actor: TensorDictModuleBase, env: EnvBase, noise: float) -> ExploringPolicy:
    """The exploring policy of an actor, within the bounds of an environment's actions."""
    spec = bounded_actions(env)
    return ExploringPolicy(actor, spec.low, spec.high, noise=noise)


def build_networks(
    config: DictConfig,
    env: EnvBase,
    num_costs: int,
    device: torch.device,
    cost_values: CostValues | None = None,
) -> dict[str, Any]:
    """Build the actor and, unless their number in ``critics`` is 0, critics of reward and costs.

    Args:
        config: Configuration as composed from ``conf/``.
        env: Environment whose specs have the sizes of observations and actions.
        num_costs: Number of constrained costs; 0: no cost critics.
        device: Device of the parameters.
        cost_values: What the cost critics return; by default the mean.

    Raises:
        ValueError: If actions have no bounds, the observation is not a vector, or the model is for
            on-policy algorithms only.
    """
    model, spec = config.model, bounded_actions(env)
    cost_values = MeanCosts() if cost_values is None else cost_values
    size, actions = _observation_size(config, env), len(spec.low)
    common: dict[str, Any] = {
        "hidden_sizes": list(model.hidden_sizes),
        "input_scale": input_scale_vector(model.input_scale, env.observation_layout, size),
        "device": device,
    }
    bounds = {"low": spec.low, "high": spec.high}
    networks = {"actor": instantiate(config.actor, observation_size=size, **bounds, **common)}
    if number := config.critics.rewards:
        networks["critic"] = QEnsemble(size, actions, num_networks=number, **common)
    if num_costs and (number := config.critics.costs):
        networks["cost_critic"] = QEnsemble(
            size,
            actions,
            num_networks=number * cost_values.networks,
            num_outputs=num_costs * cost_values.outputs,
            out_key="cost_state_action_value",
            **common,
        )
    return networks


def _observation_size(config: DictConfig, env: EnvBase) -> int:
    """Length of the observation, one vector; refuses other observations, and on-policy models."""
    model = config.model
    if others := [key for key in _ON_POLICY_ONLY if model.get(key)]:
        raise ValueError(
            f"algo={config.algo.name} takes model=mlp only, and model.{others[0]} is for on-policy "
            "algorithms. Use model=mlp without it."
        )
    observed = observed_entries(env.observation_spec)
    if observed[0].key != "observation" or len(observed[0].shape) != 1:
        raise ValueError(
            f"algo={config.algo.name} needs an observation of one vector, and this environment "
            f"observes {', '.join(map(str, observed))}: {TO_FLATTEN}, or use algo=ppo_lagrangian "
            "with model=dict or model=cnn."
        )
    return int(observed[0].shape[0])
