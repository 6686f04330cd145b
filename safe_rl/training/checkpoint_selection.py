"""Selection of the best checkpoints: each policy is scored by its own episodes."""

from __future__ import annotations

import copy
import math
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

from safe_rl.algorithms.algorithm_contract import Stateful, states_of
from safe_rl.resumable import Resumable
from safe_rl.runs.table import feasible_return

# most epochs to wait: waiting policies are in main memory and in every checkpoint
_LONGEST = 10


def epochs_until_scored(over: int, length: float, steps_per_epoch: float) -> int:
    """Epochs from a policy's update until the finished episodes are, on average, its own.

    A policy collects its batch in the epoch after its update. Episodes that are longer than a batch
    began before it. Those that end half an episode length after the batch are centred on it.
    Returns and costs are averaged over a number of epochs, `over`.

    Examples:
        >>> epochs_until_scored(over=1, length=1000, steps_per_epoch=1000)
        1
        >>> epochs_until_scored(over=3, length=1000, steps_per_epoch=200)
        4
    """
    lag = int(length / steps_per_epoch / 2)
    return 1 + min(_LONGEST, lag + over // 2)


class CheckpointSelection(Resumable):
    """Policies that wait for the epochs in which their own episodes end.

    Args:
        components: Parts of the run, by name, that a checkpoint of a policy has.
        limits: Cost key -> d, undiscounted cost per episode.
        over: Number of epochs over which returns and costs are averaged.
        steps_per_epoch: Steps of an environment in an epoch.
        longest: Largest length of an episode, used as the mean length until an episode has ended.

    Attributes:
        waiting: The policies: ``steps`` of the run then, and ``states`` by name.
    """

    state_names = ("waiting",)

    def __init__(
        self,
        components: Mapping[str, Stateful],
        limits: Mapping[str, float],
        *,
        over: int,
        steps_per_epoch: float,
        longest: float,
    ) -> None:
        self._components, self._limits = dict(components), dict(limits)
        self._over, self._steps_per_epoch, self._length = over, steps_per_epoch, float(longest)
        self._latest: deque[Mapping[str, float]] = deque(maxlen=over)
        self.waiting: list[dict[str, Any]] = []

    def add(self, row: Mapping[str, float]) -> list[dict[str, Any]]:
        """Add an epoch, a row of the table, and score the waiting policy whose epochs are complete.

        Returns:
            Keyword arguments of `CheckpointStore.save_best` for the policy, if it kept every limit.
            If episodes have become shorter, several are due, and only the latest is scored.
        """
        self.take(row)
        states = copy.deepcopy(states_of(self._components))
        self.waiting.append({"steps": row["steps"], "states": states})
        delay = epochs_until_scored(self._over, self._length, self._steps_per_epoch)
        due = max(0, len(self.waiting) - delay)
        passed, self.waiting = self.waiting[:due], self.waiting[due:]
        return self._score(passed[-1:])

    def take(self, row: Mapping[str, float]) -> None:
        """Add an epoch of a run that is resumed, from which no policy waits."""
        self._latest.append(row)
        length = row.get("episode_length", math.nan)
        self._length = length if math.isfinite(length) else self._length

    def score_all(self) -> list[dict[str, Any]]:
        """Score all waiting policies by the epochs so far, at the end of a run.

        They keep waiting, because a resumed run has later epochs to score them by.
        """
        return self._score(self.waiting)

    def _score(self, policies: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
        score = feasible_return(self._latest, self._limits)
        if score is None:
            return []
        return [{"steps": p["steps"], "score": score, "states": p["states"]} for p in policies]
