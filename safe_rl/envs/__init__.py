"""Safety Gym environments: configurations, the benchmark suite and the batched environment."""

# First, because it imports MuJoCo where OpenGL is missing.
from safe_rl.envs.opengl import OpenGLError

# isort: split
from safe_rl.envs.errors import ConfigError
from safe_rl.envs.gymnasium.conversion import from_gymnasium
from safe_rl.envs.safety_gym.env import SafetyGymEnv
from safe_rl.envs.safety_gym.records.config import SafetyGymConfig
from safe_rl.envs.safety_gym.registration import (
    make_env,
    register_gymnasium,
    store_config,
    store_configs,
)
from safe_rl.envs.safety_gym.suite import EXTRAS, SUITE, resolve
from safe_rl.envs.safety_gym.world.layout import LayoutError

__all__ = [
    "EXTRAS",
    "SUITE",
    "ConfigError",
    "LayoutError",
    "OpenGLError",
    "SafetyGymConfig",
    "SafetyGymEnv",
    "from_gymnasium",
    "make_env",
    "resolve",
    "store_config",
    "store_configs",
]

register_gymnasium()
