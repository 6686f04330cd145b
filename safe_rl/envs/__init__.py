"""Safety Gym environments: configurations, the benchmark suite and the batched environment."""

# First, because it imports MuJoCo where OpenGL is missing.
from safe_rl.envs.rendering.opengl import OpenGLError

# isort: split
from safe_rl.envs.config import SafetyGymConfig
from safe_rl.envs.gymnasium.conversion import from_gymnasium
from safe_rl.envs.layout import LayoutError
from safe_rl.envs.registration import make_env, register_gymnasium, store_config, store_configs
from safe_rl.envs.safety_gym import SafetyGymEnv
from safe_rl.envs.suite import EXTRAS, SUITE, resolve
from safe_rl.envs.validation import ConfigError

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
