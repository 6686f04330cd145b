"""Candidates for the best checkpoints: each policy is judged by its own episodes."""

from __future__ import annotations

import copy
import math
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

from safe_rl.algorithms.algorithm_contract import Stateful
from safe_rl.resumable import Resumable
from safe_rl.runs.outcome import feasible_return

# most epochs to wait: waiting policies are in main memory and in every checkpoint
_LONGEST = 10


def epochs_until_judged(over: int, length: float, steps_per_epoch: float) -> int:
    """Epochs from a policy's update until the finished episodes are, on average, its own.

    A policy collects its batch in the epoch after its update. Episodes that are longer than a batch
    began before it. Those that end half an episode length after the batch are centred on it.
    Returns and costs are averaged over a number of epochs, `over`.

    Examples:
        >>> epochs_until_judged(over=1, length=1000, steps_per_epoch=1000)
        1
        >>> epochs_until_judged(over=3, length=1000, steps_per_epoch=200)
        4
    """
    lag = length / steps_per_epoch / 2 if length > steps_per_epoch else 0.0
    return 1 + min(_LONGEST, int(lag) + over // 2)


class Judged(NamedTuple):
    """A policy that kept every limit: the arguments of `CheckpointStore.save_best`.

    Attributes:
        steps: Environment steps of the run when it was the current policy.
        score: Its return.
        facts: Facts about it for its checkpoint.
        states: States of the parts of the run at that time, by name.
    """

    steps: int
    score: float
    facts: dict[str, Any]
    states: dict[str, Any]


class Candidates(Resumable):
    """Policies that wait for the epochs in which their own episodes end.

    Args:
        components: Parts of the run, by name, that a checkpoint of a policy has.
        limits: Cost key -> d, undiscounted cost per episode.
        over: Number of epochs over which returns and costs are averaged.
        delay: Function of the mean episode length. It returns how many epochs after its update a
            policy is judged.
        longest: Largest length of an episode, used as the mean length until an episode has ended.

    Attributes:
        waiting: The policies: ``steps`` and ``epoch`` of the run then, and ``states`` by name.
    """

    state_names = ("waiting",)

    def __init__(
        self,
        components: Mapping[str, Stateful],
        limits: Mapping[str, float],
        *,
        over: int,
        delay: Callable[[float], int],
        longest: float,
    ) -> None:
        self._components, self._limits = dict(components), dict(limits)
        self._delay, self._length = delay, float(longest)
        self._latest: deque[Mapping[str, float]] = deque(maxlen=over)
        self.waiting: list[dict[str, Any]] = []

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Restore the waiting policies.

        Raises:
            ValueError: If one lacks its steps, its epoch or its states.
        """
        super().load_state_dict(state_dict)
        kinds = {"steps": int, "epoch": int, "states": dict}
        for policy in self.waiting:
            if not isinstance(policy, dict) or {k: type(v) for k, v in policy.items()} != kinds:
                raise ValueError(
                    "a waiting policy must have whole 'steps' and 'epoch', and 'states'."
                )

    def continue_after(self, rows: Iterable[Mapping[str, float]]) -> None:
        """Add the epochs of a run that is resumed."""
        for row in rows:
            self._take(row)

    def add(self, row: Mapping[str, float]) -> list[Judged]:
        """Add an epoch, and judge the waiting policy whose epochs are complete.

        Args:
            row: Of the run's table, by column.

        Returns:
            The judged policy, if it kept every limit. If episodes have become shorter, several
            are due, and only the latest is judged.
        """
        self._take(row)
        states = {name: copy.deepcopy(part.state_dict()) for name, part in self._components.items()}
        self.waiting.append({"steps": row["steps"], "epoch": row["epoch"], "states": states})
        due = len(self.waiting) - self._delay(self._length)
        passed = [self.waiting.pop(0) for _ in range(due)]
        return self._judge(passed[-1]) if passed else []

    def _take(self, row: Mapping[str, float]) -> None:
        self._latest.append(row)
        length = row.get("episode_length", math.nan)
        self._length = length if math.isfinite(length) else self._length

    def judge_all(self) -> list[Judged]:
        """Judge all waiting policies by the epochs so far, at the end of a run.

        They keep waiting, because a resumed run has later epochs to judge them by.
        """
        return [judged for policy in self.waiting for judged in self._judge(policy)]

    def _judge(self, policy: Mapping[str, Any]) -> list[Judged]:
        score = feasible_return(self._latest, self._limits)
        if score is None:
            return []
        return [Judged(policy["steps"], score, {"epoch": policy["epoch"]}, policy["states"])]
