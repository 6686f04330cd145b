"""Environments of every family, the contract they fulfil, and their names.

Names and keys are imported at once. Modules that build environments are imported at first use.
"""

import os
from typing import TYPE_CHECKING

from safe_rl.envs.families import (
    complete_env,
    env_names,
    env_node,
    make_env,
    store_config,
    store_configs,
)
from safe_rl.envs.keys import ConfigError
from safe_rl.envs.safety_gym.config import SafetyGymConfig
from safe_rl.envs.safety_gym.suite import EXTRAS, SUITE, resolve
from safe_rl.extras import import_later

if TYPE_CHECKING:
    from safe_rl.envs.contract import ConstrainedEnv, ContractError, check_constrained_env
    from safe_rl.envs.gymnasium.conversion import from_gymnasium
    from safe_rl.envs.pictures import OpenGLError
    from safe_rl.envs.safety_gym.env import SafetyGymEnv
    from safe_rl.envs.safety_gym.layouts import LayoutError

__all__ = [
    "EXTRAS",
    "SUITE",
    "ConfigError",
    "ConstrainedEnv",
    "ContractError",
    "LayoutError",
    "OpenGLError",
    "SafetyGymConfig",
    "SafetyGymEnv",
    "check_constrained_env",
    "complete_env",
    "env_names",
    "env_node",
    "from_gymnasium",
    "make_env",
    "resolve",
    "store_config",
    "store_configs",
]

__getattr__, __dir__ = import_later(
    __name__,
    {
        "contract": ["ConstrainedEnv", "ContractError", "check_constrained_env"],
        "gymnasium.conversion": ["from_gymnasium"],
        "pictures": ["OpenGLError"],
        "safety_gym.env": ["SafetyGymEnv"],
        "safety_gym.layouts": ["LayoutError"],
    },
)

if os.environ.get("MUJOCO_GL"):  # MuJoCo then loads OpenGL; this module can do without
    import safe_rl.envs.pictures  # noqa: F401
