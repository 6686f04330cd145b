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
        gammas: Entry below ``next`` that is summed over n steps -> discount per step.
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
        ...     gammas={"reward": 0.99}, n_steps=1, keep=True,
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
        gammas: Mapping[NestedKey, float],
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
        keys_of: dict[float, list[NestedKey]] = {}
        for key, gamma in gammas.items() if n_steps > 1 else ():
            keys_of.setdefault(gamma, []).append(key)
        # its default done_keys keep `terminated` of the first step, so that values would be
        # bootstrapped beyond an end within the n steps
        self._n_step_transforms = [
            MultiStepTransform(n_steps, gamma, reward_keys=keys, done_keys=[])
            for gamma, keys in keys_of.items()
        ]
        self._open_ids: Tensor | None = None  # of the last steps' trajectories; -1: it has ended
        self._spanned = ["steps_to_next_obs"] if self._n_step_transforms else []

    def __len__(self) -> int:
        """Number of transitions in the buffer."""
        return len(self._buffer)

    def extend(self, batch: TensorDictBase) -> None:
        """Add the steps [N, T] that follow those of the last call.

        Where a collector's ``traj_ids`` say that they do not, sums over n steps end, too.
        """
        if not self._n_step_transforms:
            self._add([batch])
            return
        wanted = batch.select(*{("next", "done"), *self.in_keys})
        if (ids := batch.get(("collector", "traj_ids"), None)) is not None:
            ids, last = ids.reshape(batch.shape), self._open_ids
            if last is not None and ((last != ids[..., 0]) & (last >= 0)).any():
                self.end_rows()
            self._open_ids = ids[..., -1].masked_fill(wanted["next", "done"][..., -1, 0], -1)
        self._add([self._over_steps(piece) for piece in wanted.split(_LONGEST_ROW, -1)])

    def _add(self, given: list[TensorDictBase | None]) -> None:
        pieces = [
            piece.select(*self.in_keys, *self._spanned) for piece in given if piece is not None
        ]
        if pieces:  # there may be fewer than n steps so far
            steps = pieces[0] if len(pieces) == 1 else torch.cat(pieces, -1)
            self._buffer.extend(steps.reshape(-1))

    def _over_steps(self, piece: TensorDictBase) -> TensorDictBase | None:
        """Transitions over n steps; None if there are fewer than n steps so far.

        The transforms remember the steps whose sums are not complete.
        """
        first, *others = self._n_step_transforms
        transitions: TensorDictBase | None = first.inv(piece)
        for transform in others:
            sums = transform.inv(piece.select(*_read_by(transform)))
            if transitions is not None:
                transitions["next"].update(sums["next"].select(*transform.reward_keys))
        return transitions

    def end_rows(self) -> None:
        """Complete the sums over n steps, because the next batch does not follow the last one."""
        # TorchRL has no public access to the steps whose sums are not complete
        if not self._n_step_transforms or self._n_step_transforms[0]._buffer is None:
            return
        waiting = self._n_step_transforms[0]._buffer.clone()
        waiting["next", "done"][..., -1, :] = True
        self._set_waiting(waiting)
        beyond = waiting[..., -1:].expand(*waiting.shape[:-1], self._n_step_transforms[0].n_steps)
        self._add([self._over_steps(beyond)])
        self._set_waiting(None)

    def _set_waiting(self, steps: TensorDictBase | None) -> None:
        """Set the last steps, whose sums are not complete."""
        for number, transform in enumerate(self._n_step_transforms):
            kept = steps if steps is None or not number else steps.select(*_read_by(transform))
            transform._buffer = kept

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
        tail = self._n_step_transforms[0]._buffer if self._n_step_transforms else None
        if tail is not None:
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
        self._set_waiting(None)
        self._open_ids = None
        if self._n_step_transforms and "tail" in state_dict:
            tail, shape = state_dict["tail"], state_dict["tail_shape"]
            self._set_waiting(self._restored(tail, shape, [("next", "done")]))

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


def _read_by(transform: MultiStepTransform) -> list[NestedKey]:
    """Entries of steps from which sums are computed."""
    return [("next", key) for key in ("done", *transform.reward_keys)]
