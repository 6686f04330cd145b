"""Velocity-limited locomotion: Gymnasium's robots, batched, with a cost for running too fast."""

from typing import TYPE_CHECKING

from safe_rl.envs.velocity.config import VelocityConfig
from safe_rl.envs.velocity.nodes import velocity_node
from safe_rl.envs.velocity.suite import VELOCITY_SUITE, resolve_velocity
from safe_rl.lazy import import_later

if TYPE_CHECKING:
    from safe_rl.envs.velocity.env import VelocityEnv

__all__ = [
    "VELOCITY_SUITE",
    "VelocityConfig",
    "VelocityEnv",
    "resolve_velocity",
    "velocity_node",
]

__getattr__, __dir__ = import_later(__name__, {"VelocityEnv": "safe_rl.envs.velocity.env"})
