"""What the training loop asks of an algorithm, and a configuration of a recipe for one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs import EnvBase

from safe_rl.collectors import EpisodeStatistics

__all__ = ["Algorithm", "PolicyUpdate", "Recipe", "Stateful"]


class Stateful(Protocol):
    """Anything with a ``state_dict``."""

    def state_dict(self) -> Mapping[str, Any]:
        """Everything that an exact continuation needs."""
        ...

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> Any:
        """Continue from :meth:`state_dict`."""
        ...


class Algorithm(Protocol):
    """What learns: all that the loop, checkpoints, transfer and evaluation know of it.

    Attributes:
        cost_keys: Keys of the constrained costs; empty for an unconstrained algorithm.
        policy: What explores, for the collector: it shares the networks' parameters.
        networks: What is trained, by name. Another run can start from them; those whose names
            begin with ``cost_`` are then taken over only if both runs constrain the same costs.

    If something else has to follow when the networks begin with the weights of another run, such as
    target networks, a method ``networks_were_given`` sees to it. Where a run that is resumed begins
    new episodes, ``forget_open_episodes`` ends what goes from step to step, such as n-step sums.

    If checkpoints do not hold all that learning depends on, ``lost_on_resume`` is a sentence on
    what a run that is resumed has lost.
    """

    @property
    def cost_keys(self) -> Sequence[str]: ...  # noqa: D102

    @property
    def policy(self) -> TensorDictModuleBase: ...  # noqa: D102

    @property
    def networks(self) -> Mapping[str, nn.Module]: ...  # noqa: D102

    def learn(self, batch: TensorDictBase, episodes: EpisodeStatistics) -> dict[str, float]:
        """Learn from what the policy has just collected.

        Args:
            batch: Steps [N, T], in order of time.
            episodes: What they say about episodes.

        Returns:
            What is worth a column of the table, by name: the same names at every call, NaN where
            there is no value.
        """
        ...

    def checkpoint_components(self) -> Mapping[str, Stateful]:
        """Parts with a state, by name: together they are all that learning depends on."""
        ...


class Recipe(Protocol):
    """How an algorithm is put together; a configuration names it as ``algo._target_``.

    ``unread``, if it has one, holds keys that presets bring along and that it makes no use of, and
    choices that are not for it (``preset=paper``), each with the reason: on a command line they are
    refused.
    """

    @classmethod
    def build(cls, config: DictConfig, env: EnvBase) -> Algorithm:
        """Build everything from a configuration as composed from ``conf/``.

        Raises:
            ValueError: If parts of the configuration do not fit together or the environment.
        """
        ...

    @classmethod
    def build_policy(
        cls, config: DictConfig, env: EnvBase, device: torch.device
    ) -> tuple[TensorDictModuleBase, Mapping[str, nn.Module]]:
        """Build only what acts, for evaluation.

        Returns:
            The policy, and the networks that it consists of, by the names that they have in
            checkpoints.
        """
        ...


class PolicyUpdate(Protocol):
    """What a recipe asks of an update: gradient steps, a trust-region step, or one of your own."""

    def __call__(
        self, batch: TensorDictBase, cost_violation: Tensor, episode_length: Tensor
    ) -> Mapping[str, Tensor]:
        """Improve the policy on ``batch`` and return diagnostics.

        Args:
            batch: On-policy data with advantages, any batch shape.
            cost_violation: By how much J_c is to fall, of every constraint, shape [k]: J_c − d, or
                J_c less the column ``target_…`` where the limit comes down to d.
            episode_length: Mean episode length T̄ in steps, a scalar.
        """
        ...

    def state_dict(self) -> Mapping[str, Any]:
        """State beyond the network's parameters, for an exact continuation."""
        ...

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> Any:
        """Continue from :meth:`state_dict`."""
        ...
