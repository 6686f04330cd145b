"""Transforms of TorchRL that change a constrained problem, for any environment and algorithm."""

from safe_rl.envs.transforms.action_delay import ActionDelay
from safe_rl.envs.transforms.action_filter import ActionFilter
from safe_rl.envs.transforms.base import ConstraintTransform
from safe_rl.envs.transforms.early_termination import EarlyTermination
from safe_rl.envs.transforms.environment import TransformedConstrainedEnv, transform_env
from safe_rl.envs.transforms.policy_memory import PolicyMemory
from safe_rl.envs.transforms.reward_scale import RewardScale
from safe_rl.envs.transforms.saute import Saute, Simmer
from safe_rl.envs.transforms.sensor_noise import SensorNoise

__all__ = [
    "ActionDelay",
    "ActionFilter",
    "ConstraintTransform",
    "EarlyTermination",
    "PolicyMemory",
    "RewardScale",
    "Saute",
    "SensorNoise",
    "Simmer",
    "TransformedConstrainedEnv",
    "transform_env",
]
