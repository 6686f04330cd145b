"""Velocity-limited locomotion: Gymnasium's robots, batched, with a cost for running too fast."""

from safe_rl.envs.velocity.config import VelocityConfig
from safe_rl.envs.velocity.env import VelocityEnv
from safe_rl.envs.velocity.nodes import velocity_node
from safe_rl.envs.velocity.suite import VELOCITY_SUITE, resolve_velocity

__all__ = [
    "VELOCITY_SUITE",
    "VelocityConfig",
    "VelocityEnv",
    "resolve_velocity",
    "velocity_node",
]
