"""TorchRL transforms that change a constrained problem, for any environment and algorithm."""

from safe_rl.envs.transforms.action_transforms import ActionDelay, ActionFilter, ActionRepeat
from safe_rl.envs.transforms.environment import (
    ConstraintTransform,
    TransformedConstrainedEnv,
    transform_env,
)
from safe_rl.envs.transforms.observation_transforms import (
    ObservedCosts,
    RecurrentState,
    SensorNoise,
)
from safe_rl.envs.transforms.reward_transforms import EarlyTermination, Saute, Simmer

__all__ = [
    "ActionDelay",
    "ActionFilter",
    "ActionRepeat",
    "ConstraintTransform",
    "EarlyTermination",
    "ObservedCosts",
    "RecurrentState",
    "Saute",
    "SensorNoise",
    "Simmer",
    "TransformedConstrainedEnv",
    "transform_env",
]
