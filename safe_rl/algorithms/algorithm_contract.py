"""Interfaces between the training loop, algorithms and updates.

Each class here is a base class. Its optional methods have defaults.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping
from inspect import isclass
from typing import Any, Protocol, Self

import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs import EnvBase

from safe_rl.checks import Checked
from safe_rl.collectors import EpisodeStatistics
from safe_rl.objectives import LimitState
from safe_rl.resumable import Resumable
from safe_rl.trust import TargetError, instantiate, locate

_DEFAULT = "safe_rl.algorithms.OnPolicy"


class Stateful(Protocol):
    """Anything with a ``state_dict``."""

    def state_dict(self) -> Mapping[str, Any]:
        """State from which a resumed run continues exactly."""
        ...

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> Any:
        """Continue from `state_dict`."""
        ...


def states_of(parts: Mapping[str, Stateful]) -> dict[str, Any]:
    """State of every part, by name."""
    return {name: part.state_dict() for name, part in parts.items()}


def networks_of_target(
    model: DictConfig, env: EnvBase, num_costs: int, device: torch.device, **others: Any
) -> dict[str, Any]:
    """Networks that ``model._target_`` builds, by name.

    Raises:
        TargetError: If one is missing.
    """
    given = {
        "observation_spec": env.observation_spec,
        "action_spec": env.action_spec,
        "layout": env.observation_layout,
        "num_costs": num_costs,
        "device": device,
    }
    networks = instantiate(model, given | others)
    needed = ["actor", "critic", *(["cost_critic"] if num_costs else [])]
    missing = set(needed).difference(networks if isinstance(networks, dict) else ())
    if missing:
        raise TargetError(
            f"model._target_={model['_target_']} must return a dictionary of networks with the "
            f"names {', '.join(needed)}; it lacks {', '.join(sorted(missing))}."
        )
    return {name: networks[name] for name in needed}


class Algorithm(ABC):
    """Interface of algorithms for the training loop, checkpoints, transfer and evaluation.

    A configuration names the class as ``algo._target_``, and says ``algo.constrained: false`` if
    it keeps no limits; other runs are certified.

    Attributes:
        policy: Exploring policy, for the collector; it shares the networks' parameters.
        networks: Trained networks, by name. Another run can start from them.
        cost_networks: Names of the networks of the constrained costs. A run starts from another
            run's cost networks only if both have the same costs.
        learns_from: A sentence on the data besides the run's own steps that it learns from; empty
            if there are none.
        schedule: A sentence on when the limits begin to hold; empty if they do from the start.
    """

    policy: TensorDictModuleBase
    networks: Mapping[str, nn.Module]
    cost_networks: Collection[str] = ()
    learns_from: str = ""
    schedule: str = ""

    @classmethod
    @abstractmethod
    def from_config(cls, config: DictConfig, env: EnvBase) -> Self:
        """Build networks, losses and updates from a configuration as composed from ``conf/``.

        Raises:
            ValueError: If parts of the configuration do not fit together or the environment.
        """

    @classmethod
    @abstractmethod
    def build_policy(
        cls, config: DictConfig, env: EnvBase, device: torch.device
    ) -> tuple[TensorDictModuleBase, Mapping[str, nn.Module]]:
        """Build only the policy, for evaluation.

        Returns:
            The policy, and the networks that it consists of, by the names that they have in
            checkpoints.
        """

    @property
    def lost_on_resume(self) -> str:
        """A sentence on the state that checkpoints do not have; empty if they have all of it."""
        return ""

    @abstractmethod
    def learn(self, batch: TensorDictBase, episodes: EpisodeStatistics) -> dict[str, float]:
        """Learn from the batch that the policy has just collected.

        Args:
            batch: Steps [N, T], in order of time.
            episodes: Statistics of the episodes in the batch.

        Returns:
            Values for columns of the run's table, by name: the same names at every call, with NaN
            where there is no value.
        """

    @abstractmethod
    def checkpoint_components(self) -> Mapping[str, Stateful]:
        """Parts with a state, by name; learning depends on nothing else."""

    def networks_replaced(self) -> None:
        """Copy the networks, which got another run's weights, into the target networks."""

    def forget_open_episodes(self) -> None:
        """End the n-step sums of unfinished episodes, because new episodes begin."""


def find_algorithm(config: DictConfig) -> type[Algorithm]:
    """The class that a configuration names as ``algo._target_``; by default `OnPolicy`.

    Raises:
        TargetError: If there is no such class, or it is not an algorithm.
    """
    target = config.algo.get("_target_", _DEFAULT)
    algorithm = locate(target, "algo._target_")
    if not (isclass(algorithm) and issubclass(algorithm, Algorithm)):
        raise TargetError(
            f"algo._target_={target} is no algorithm: derive it from safe_rl.algorithms.Algorithm."
        )
    return algorithm


class PolicyUpdate(Checked, Resumable, ABC):
    """Interface of a policy update: gradient steps, a trust-region step, or your own.

    ``state_names`` are attributes that an exact continuation needs, besides the networks'
    parameters.
    """

    @abstractmethod
    def __call__(
        self, batch: TensorDictBase, limits: LimitState | None = None
    ) -> Mapping[str, Tensor]:
        """Improve the policy on ``batch`` and return diagnostics.

        Args:
            batch: On-policy data with advantages, any batch shape.
            limits: State of the limits after this batch, as `Constraints.update` returns it; None
                if there are no limits.
        """

    def loss_modules(self) -> Mapping[str, nn.Module]:
        """Losses that are modules, by name. Checkpoints save their state beside the networks."""
        return {}
