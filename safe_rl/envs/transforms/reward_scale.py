"""Rewards in units that critics learn quickly."""

from __future__ import annotations

import math

from tensordict import TensorDictBase
from torchrl.data import TensorSpec

from safe_rl.envs.transforms.base import (
    OWN_REWARD,
    ConstraintTransform,
    keep_reward,
    kept_reward_spec,
)

__all__ = ["RewardScale"]


class RewardScale(ConstraintTransform):
    """Multiply the rewards that are learned from by a number.

    Critics begin with values near 0 and go by steps of a learning rate. Towards values of hundreds
    all weights move one way until the hidden layers are saturated and tell states apart no more:
    discounted returns should be of the order of 1 to 10. Returns stay those of the environment's
    own reward, which is kept in `task_reward`; in evaluation `reward` stays as it is.

    Args:
        factor: what rewards are multiplied by.

    Raises:
        ValueError: for a factor that is not positive.

    Examples:
        >>> from safe_rl.envs import make_env
        >>> env = make_env("SafeHopperVelocity", seed=0, transforms={"s": RewardScale(0.01)})
        >>> step = env.rollout(2)["next"]
        >>> bool((step["reward"] == 0.01 * step[env.return_key]).all())
        True
    """

    return_key = OWN_REWARD

    def __init__(self, factor: float) -> None:
        super().__init__()
        if not (math.isfinite(factor) and factor > 0):
            raise ValueError(f"factor={factor:g} must be a number above 0.")
        self._factor = factor

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        reward = keep_reward(next_tensordict, self.return_key)
        if not self.evaluating:
            next_tensordict.set("reward", self._factor * reward)
        return next_tensordict

    def transform_reward_spec(self, reward_spec: TensorSpec) -> TensorSpec:
        """Add the environment's own reward."""
        return kept_reward_spec(reward_spec, self.return_key)
