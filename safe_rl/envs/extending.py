"""Adding to Safety Gym's vocabulary from outside the package, see `safety_gym.extending`."""

from safe_rl.envs.safety_gym.extending import *  # noqa: F403
from safe_rl.envs.safety_gym.extending import __all__ as __all__
