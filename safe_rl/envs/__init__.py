"""Safety Gym environments: configurations, the benchmark suite and the batched environment."""

from safe_rl.envs.config import SafetyGymConfig
from safe_rl.envs.layout import LayoutError
from safe_rl.envs.safety_gym import SafetyGymEnv
from safe_rl.envs.suite import SUITE, resolve
from safe_rl.envs.validation import ConfigError

__all__ = ["SUITE", "ConfigError", "LayoutError", "SafetyGymConfig", "SafetyGymEnv", "resolve"]
