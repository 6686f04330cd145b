"""Velocity-limited locomotion: batches of Gymnasium's robots, with a cost for high speed."""

from typing import TYPE_CHECKING

from safe_rl.envs.velocity.velocity_config import VELOCITY_SUITE, VelocityConfig, resolve_velocity
from safe_rl.extras import import_later

if TYPE_CHECKING:
    from safe_rl.envs.velocity.velocity_env import VelocityEnv

__all__ = ["VELOCITY_SUITE", "VelocityConfig", "VelocityEnv", "resolve_velocity"]

__getattr__, __dir__ = import_later(__name__, {"velocity_env": ["VelocityEnv"]})
