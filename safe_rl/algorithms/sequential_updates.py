"""Several updates of one policy on one batch."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tensordict import TensorDictBase
from torch import Tensor, nn

from safe_rl.algorithms.algorithm_contract import PolicyUpdate

__all__ = ["SequentialUpdates"]


class SequentialUpdates(PolicyUpdate):
    """A `PolicyUpdate` of several, each going on from where the one before has left the policy.

    In a configuration, ``then`` names what comes after ``policy_update``: a loss and an update for
    each of any number of names (see ``conf/algo/cup.yaml``).

    Args:
        first: the first update; what it reports keeps its names.
        then: the others in their order; what they report is called ``<name>_…``. The
            ``cost_surrogate`` of the last one that has any is that of all together.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> class Fixed(PolicyUpdate):
        ...     def __init__(self, kl):
        ...         self.kl = torch.tensor(kl)
        ...     def __call__(self, batch, cost_violation, episode_length):
        ...         return {"kl": self.kl}
        >>> update = SequentialUpdates(Fixed(0.01), {"projection": Fixed(0.02)})
        >>> update(TensorDict(), torch.zeros(1), torch.ones(()))
        {'kl': tensor(0.0100), 'projection_kl': tensor(0.0200)}
    """

    def __init__(self, first: PolicyUpdate, then: Mapping[str, PolicyUpdate]) -> None:
        self.first, self.then = first, dict(then)

    def __call__(
        self,
        batch: TensorDictBase,
        cost_violation: Tensor | None = None,
        episode_length: Tensor | None = None,
    ) -> dict[str, Tensor]:
        """Take all updates on one batch; see `PolicyUpdate`."""
        given = (batch, cost_violation, episode_length)
        metrics = dict(self.first(*given))
        for name, update in self.then.items():
            reported = dict(update(*given))
            predicted = reported.pop("cost_surrogate", None)
            metrics |= {f"{name}_{key}": value for key, value in reported.items()}
            if predicted is not None:
                metrics["cost_surrogate"] = predicted
        return metrics

    def loss_modules(self) -> dict[str, nn.Module]:
        """Losses of all; those of the others are called ``loss.<name>``."""
        found = dict(self.first.loss_modules())
        for name, update in self.then.items():
            for place, loss in update.loss_modules().items():
                found[f"loss.{name}{place.removeprefix('loss')}"] = loss
        return found

    def state_dict(self) -> dict[str, Any]:
        """State of each, by its name; that of the first by ``first``."""
        return {name: update.state_dict() for name, update in self._named.items()}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Continue from :meth:`state_dict`."""
        for name, update in self._named.items():
            update.load_state_dict(state_dict[name])

    @property
    def _named(self) -> dict[str, PolicyUpdate]:
        return {"first": self.first, **self.then}
