"""The reward, as Gymnasium's environments of version 5 have it: a function over tensors."""

from __future__ import annotations

from torch import Tensor

from safe_rl.envs.velocity.config import VelocityConfig


def locomotion_reward(
    config: VelocityConfig, velocity_x: Tensor, control: Tensor, healthy: Tensor, forces: Tensor
) -> Tensor:
    """Reward running forward and being healthy, not control and contact.

    Args:
        config: weights and ranges.
        velocity_x: [N] (m/s).
        control: [N, nu].
        healthy: bool [N].
        forces: on all bodies [N, nbody, 6] (N, N m), `cfrc_ext`; may be empty where the weight of
            contacts is 0 or None.

    Returns:
        [N].
    """
    reward = config.forward_reward_weight * velocity_x
    if config.healthy_reward is not None:
        reward = reward + config.healthy_reward * healthy
    reward = reward - config.ctrl_cost_weight * control.square().sum(-1)
    if config.contact_cost_weight:
        reward = reward - contact_cost(config, forces)
    return reward


def contact_cost(config: VelocityConfig, forces: Tensor) -> Tensor:
    """Weight the sum of squared forces, all within their ranges: [N, nbody, 6] -> [N]."""
    assert config.contact_cost_weight is not None
    if config.contact_force_range is not None:
        forces = forces.clamp(*config.contact_force_range)
    cost = config.contact_cost_weight * forces.square().sum((-2, -1))
    return cost if config.contact_cost_range is None else cost.clamp(*config.contact_cost_range)
