"""Prioritised replay, in torch alone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torchrl.data.replay_buffers.samplers import Sampler
from torchrl.data.replay_buffers.storages import Storage

__all__ = ["ProportionalSampler"]

_SMALLEST = 1e-8
"""What is added to an error, so that every transition can be drawn."""


class ProportionalSampler(Sampler):
    """Draws transition i with probability p_i / Σ p, where p = (|TD error| + ε)^α.

    Schaul et al. 2016, section 3.3; what is drawn is weighed by (p_i / min p)^−β (section 3.4, with
    the largest weight 1). New transitions have the largest p so far.

    TorchRL's `PrioritizedSampler` needs a compiled extension that is missing wherever torch is
    newer than the one it was built for, draws from NumPy's generator, which a run does not seed,
    and leaves new transitions without a priority. This one sums all priorities for every draw: a
    millisecond for a million transitions.

    Args:
        capacity: Transitions that there can be.
        alpha: α, 0 for uniform draws.
        beta: β, 0 for no weights.

    Raises:
        ValueError: If an exponent is negative.

    Examples:
        >>> from torchrl.data import LazyTensorStorage, ReplayBuffer
        >>> sampler = ProportionalSampler(10, alpha=1.0, beta=1.0)
        >>> buffer = ReplayBuffer(storage=LazyTensorStorage(10), sampler=sampler, batch_size=1000)
        >>> _ = buffer.extend(torch.arange(4))
        >>> buffer.update_priority(torch.arange(4), torch.tensor([0.0, 1.0, 0.0, 3.0]))
        >>> sorted(set(buffer.sample().tolist()))
        [1, 3]
    """

    def __init__(self, capacity: int, *, alpha: float, beta: float) -> None:
        if min(alpha, beta) < 0:
            raise ValueError(f"alpha={alpha} and beta={beta} must be at least 0.")
        self.alpha, self.beta = alpha, beta
        self._priorities = torch.zeros(capacity, dtype=torch.float64)
        self._largest = 1.0

    def add(self, index: int | Tensor) -> None:
        """Give new transitions the largest priority so far."""
        self._priorities[torch.as_tensor(index).cpu()] = self._largest

    extend = add

    def sample(self, storage: Storage, batch_size: int) -> tuple[Tensor, dict[str, Tensor]]:
        """Draw with replacement.

        Returns:
            Indices [B] and, as ``priority_weight``, the importance weights [B].
        """
        present = self._priorities[: len(storage)]
        sums = present.cumsum(0)
        drawn = torch.rand(batch_size, dtype=sums.dtype, generator=self._rng) * sums[-1]
        index = torch.searchsorted(sums, drawn, right=True).clamp_max(len(present) - 1)
        weight = (present[index] / present.min()) ** -self.beta
        return index, {"priority_weight": weight.float()}

    @torch.no_grad()
    def update_priority(
        self,
        index: int | Tensor,
        priority: float | Tensor,
        *,
        storage: Storage | None = None,
    ) -> None:
        """Set the priorities of transitions by their errors."""
        errors = torch.as_tensor(priority).to(self._priorities).abs()
        raised = (errors + _SMALLEST) ** self.alpha
        self._priorities[torch.as_tensor(index).cpu()] = raised
        self._largest = max(self._largest, raised.max().item())

    def state_dict(self) -> dict[str, Any]:
        """All priorities."""
        return {"priorities": self._priorities.clone(), "largest": self._largest}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Continue from :meth:`state_dict`."""
        self._priorities.copy_(state_dict["priorities"])
        self._largest = float(state_dict["largest"])

    def dumps(self, path: Path) -> None:
        """Write the state into a folder."""
        torch.save(self.state_dict(), Path(path) / "sampler.pt")

    def loads(self, path: Path) -> None:
        """Continue from what `dumps` has written."""
        self.load_state_dict(torch.load(Path(path) / "sampler.pt", weights_only=True))

    def _empty(self) -> None:
        self._priorities.zero_()
        self._largest = 1.0
