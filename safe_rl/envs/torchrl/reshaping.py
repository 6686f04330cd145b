"""Environments with a batch dimension more, or one less, than they were written with."""

from __future__ import annotations

from typing import Any

from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase

__all__ = ["Alone", "Rows"]


class Rows(EnvBase):
    """N copies of an environment without a state of its own, stepped at once.

    Args:
        env: Its step is a function of the TensorDict, of any batch size (`batch_locked` is False).
        num_envs: N.

    Examples:
        >>> from torchrl.envs import PendulumEnv
        >>> Rows(PendulumEnv(), 3).rollout(2)["th"].shape
        torch.Size([3, 2])
    """

    def __init__(self, env: EnvBase, num_envs: int) -> None:
        super().__init__(device=env.device, batch_size=[num_envs])
        self.env = env
        self.observation_spec = env.observation_spec.expand(num_envs)
        self.state_spec = env.state_spec.expand(num_envs)
        self.action_spec = env.full_action_spec.expand(num_envs)
        self.reward_spec = env.full_reward_spec.expand(num_envs)
        self.done_spec = env.full_done_spec.expand(num_envs)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        """Start all rows; TorchRL puts those that go on back in their places."""
        return self.env.reset(TensorDict(batch_size=self.batch_size, device=self.device), **kwargs)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        return self.env.step(tensordict)["next"]

    def _set_seed(self, seed: int | None) -> None:
        self.env.set_seed(seed)


class Alone(EnvBase):
    """An environment of batch size [1] without that dimension, for others to put in line.

    Args:
        env: The environment.

    Examples:
        >>> from torchrl.envs import PendulumEnv
        >>> Alone(Rows(PendulumEnv(), 1)).rollout(2)["th"].shape
        torch.Size([2])
    """

    def __init__(self, env: EnvBase) -> None:
        super().__init__(device=env.device, batch_size=[])
        self.env = env
        self.observation_spec = env.observation_spec[0]
        self.state_spec = env.state_spec[0]
        self.action_spec = env.full_action_spec[0]
        self.reward_spec = env.full_reward_spec[0]
        self.done_spec = env.full_done_spec[0]

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        asked = None if tensordict is None else tensordict.unsqueeze(0)
        return self.env.reset(asked, **kwargs).squeeze(0)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        return self.env.step(tensordict.unsqueeze(0))["next"].squeeze(0)

    def _set_seed(self, seed: int | None) -> None:
        self.env.set_seed(seed)
