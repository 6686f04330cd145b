"""The replay buffer."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any

import torch
from annotated_types import Interval
from pydantic import PositiveInt
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import MultiStepTransform

from safe_rl.checks import Checked
from safe_rl.naming import key_name

_MOST_AT_ONCE = 16_384
"""Largest number of transitions that are sampled in one call and then cut into minibatches."""
_LONGEST_ROW = 1_000
"""Largest number of time steps per call of TorchRL's n-step transform.

For every episode the transform reads all steps of the call, so long rows would take too long.
"""


class Memory(Checked):
    """A `TensorDictReplayBuffer` of transitions over one step or over n steps.

    A transition over n steps has the discounted sums of n rewards and of n costs, and the
    observation n steps later. If the episode ends earlier, the transition ends there;
    ``terminated`` is that of its last step. Values are bootstrapped after a time-out.

    Args:
        capacity: Largest number of transitions; the oldest are overwritten first.
        batch_size: Transitions in a minibatch.
        in_keys: Entries of a step that are stored.
        summed: Entries below ``next`` that are summed over n steps.
        gamma: Discount per step of these sums.
        n_steps: Number n of steps that a transition spans (n-step returns).
        keep: Whether checkpoints have the transitions, so that a resumed run continues exactly.
        device: Device of the minibatches.
        example: A step [N] with the entries of all steps, such as ``env.fake_tensordict()``:
            transitions of other shapes and types are not restored. None: all are.

    Attributes:
        keeps: ``keep``.

    Examples:
        >>> memory = Memory(
        ...     capacity=100, batch_size=4, in_keys=["observation", ("next", "reward")],
        ...     summed=["reward"], gamma=0.99, n_steps=1, keep=True,
        ... )
        >>> step = {"reward": torch.ones(2, 5, 1), "done": torch.zeros(2, 5, 1, dtype=torch.bool)}
        >>> batch = TensorDict(observation=torch.zeros(2, 5, 3), next=step, batch_size=[2, 5])
        >>> memory.extend(batch)
        >>> len(memory), [len(minibatch) for minibatch in memory.minibatches(3)]
        (10, [4, 4, 4])
    """

    def __init__(
        self,
        *,
        capacity: Annotated[int, Interval(ge=1, le=10**8)],
        batch_size: PositiveInt,
        in_keys: Sequence[NestedKey],
        summed: Sequence[NestedKey],
        gamma: float,
        n_steps: Annotated[int, Interval(ge=1, le=1000)],
        keep: bool,
        device: torch.device | str | None = None,
        example: TensorDictBase | None = None,
    ) -> None:
        self.batch_size, self.keeps, self.capacity = batch_size, keep, capacity
        self._example = None if example is None else example.to("meta")
        self.in_keys, self._device = list(in_keys), torch.device(device or "cpu")
        storage = LazyTensorStorage(capacity, device=self._device)
        self._buffer = TensorDictReplayBuffer(storage=storage)
        self._sums: MultiStepTransform | None = None
        if n_steps > 1:
            # its default done_keys keep `terminated` of the first step, so that values would be
            # bootstrapped beyond an end within the n steps
            self._sums = MultiStepTransform(n_steps, gamma, reward_keys=list(summed), done_keys=[])
        self._open_ids: Tensor | None = None  # of the last steps' trajectories; -1: it has ended
        self._spanned = ["steps_to_next_obs"] if n_steps > 1 else []

    def __len__(self) -> int:
        """Number of transitions in the buffer."""
        return len(self._buffer)

    def extend(self, batch: TensorDictBase) -> None:
        """Add the steps [N, T] that follow those of the last call.

        Where a collector's ``traj_ids`` say that they do not, sums over n steps end, too.
        """
        if self._sums is None:
            self._add([batch])
            return
        wanted = batch.select(*{("next", "done"), *self.in_keys})
        if (ids := batch.get(("collector", "traj_ids"), None)) is not None:
            ids, last = ids.reshape(batch.shape), self._open_ids
            if last is not None and ((last != ids[..., 0]) & (last >= 0)).any():
                self.end_rows()
            self._open_ids = ids[..., -1].masked_fill(wanted["next", "done"][..., -1, 0], -1)
        # the transform remembers the steps whose sums are not complete
        self._add([self._sums.inv(piece) for piece in wanted.split(_LONGEST_ROW, -1)])

    def _add(self, given: list[TensorDictBase | None]) -> None:
        pieces = [
            piece.select(*self.in_keys, *self._spanned) for piece in given if piece is not None
        ]
        if pieces:  # there may be fewer than n steps so far
            steps = pieces[0] if len(pieces) == 1 else torch.cat(pieces, -1)
            self._buffer.extend(steps.reshape(-1))

    def end_rows(self) -> None:
        """Complete the sums over n steps, because the next batch does not follow the last one."""
        # TorchRL has no public access to the steps whose sums are not complete
        if self._sums is None or self._sums._buffer is None:
            return
        self._sums._buffer = waiting = self._sums._buffer.clone()
        waiting["next", "done"][..., -1, :] = True
        beyond = waiting[..., -1:].expand(*waiting.shape[:-1], self._sums.n_steps)
        self._add([self._sums.inv(beyond)])
        self._sums._buffer = None

    def minibatches(self, number: int) -> Iterator[TensorDictBase]:
        """Draw a number of minibatches, several at once, which takes a tenth of the time."""
        at_once = max(1, _MOST_AT_ONCE // self.batch_size)
        for first in range(0, number, at_once):
            count = min(at_once, number - first)
            drawn = self._buffer.sample(count * self.batch_size).to(self._device)
            yield from drawn.split(self.batch_size)

    def state_dict(self) -> dict[str, Any]:
        """The transitions, the position of the next one, and the state of n-step sums."""
        size = len(self)
        state: dict[str, Any] = {"size": size, "writer": self._buffer.writer.state_dict()}
        if size:
            steps = self._buffer[:].exclude("index").flatten_keys("/")
            # of a view, torch would save the whole underlying storage
            steps = steps if size == self.capacity else steps.clone()
            state["steps"] = {key: v.as_subclass(torch.Tensor) for key, v in steps.items()}
        if self._sums is not None and (tail := self._sums._buffer) is not None:
            state["tail"] = tail.clone().flatten_keys("/").to_dict()
            state["tail_shape"] = list(tail.batch_size)
        return state

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Continue from `state_dict`.

        Raises:
            ValueError: If entries are missing, or have other shapes or types than the example's.
        """
        size, writer = state_dict["size"], state_dict["writer"]
        if size > self.capacity or writer["_cursor"] not in range(self.capacity):
            raise ValueError(f"{size} transitions, the next at {writer['_cursor']}, are too many.")
        self._buffer.empty()
        if size:
            self._buffer.extend(self._restored(state_dict["steps"], [size], self._spanned))
        self._buffer.writer.load_state_dict(writer)
        self._open_ids = None
        if self._sums is not None:
            self._sums._buffer = None
            if "tail" in state_dict:
                tail, shape = state_dict["tail"], state_dict["tail_shape"]
                self._sums._buffer = self._restored(tail, shape, [("next", "done")])

    def _restored(
        self, entries: Mapping[str, Tensor], shape: list[int], further: Sequence[NestedKey]
    ) -> TensorDictBase:
        """Saved steps of a shape, of these and further entries, compared with the example."""
        if self._example is not None:
            expected = self._example.select(*self.in_keys, strict=False).flatten_keys("/")
            rows = [*self._example.shape, *shape[1:]] if len(shape) > 1 else shape
            if missing := {*expected.keys(), *map(key_name, further)} - set(entries):
                raise ValueError(f"there is no '{min(missing)}'.")
            for key, value in expected.items():
                found, wanted = torch.as_tensor(entries[key]), [*rows, *value.shape[1:]]
                if list(found.shape) != wanted or found.dtype != value.dtype:
                    raise ValueError(
                        f"'{key}' is {found.dtype} of the shape {list(found.shape)}, expected "
                        f"{value.dtype} of the shape {wanted}."
                    )
        # the saved run may have used another device
        steps = TensorDict(entries, shape, device=self._device).unflatten_keys("/")
        return steps.select(*dict.fromkeys([*self.in_keys, *further]))
