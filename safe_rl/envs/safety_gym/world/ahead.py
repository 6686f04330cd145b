"""Layouts of the episodes to come, drawn for all rows at once."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from safe_rl.envs.safety_gym.world.layout import LayoutError


class LayoutsAhead:
    """Layouts by their keys, remembered until they are asked for.

    A layout is a function of its key alone, and to draw one takes about as long as to draw a
    hundred: where rows begin their episodes one by one, what the others will ask for next is drawn
    along. A snapshot of the worlds needs nothing of it.

    Args:
        draw: draws layouts of keys, int64 [B] -> [B, 1 + M, 2]; raises `LayoutError` if there is
            none for one of them.
        num_envs: number of rows, N.
        num_columns: 1 + M.

    Examples:
        >>> asked = []
        >>> def draw(key):
        ...     asked.append(key.tolist())
        ...     return key.view(-1, 1, 1).expand(-1, 1, 2).double()
        >>> layouts = LayoutsAhead(draw, num_envs=2, num_columns=1)
        >>> layouts(torch.tensor([1, 2]), torch.tensor([3, 4]), torch.tensor([True, False]))
        tensor([[[1., 1.]]], dtype=torch.float64)
        >>> asked  # of the second row, what comes next
        [[1, 4]]
    """

    def __init__(self, draw: Callable[[Tensor], Tensor], num_envs: int, num_columns: int) -> None:
        self._draw = draw
        self._known = torch.zeros(num_envs, dtype=torch.bool)
        self._keys = torch.zeros(num_envs, dtype=torch.int64)
        self._layouts = torch.zeros(num_envs, num_columns, 2, dtype=torch.float64)

    def __call__(self, key: Tensor, following: Tensor, mask: Tensor) -> Tensor:
        """Layouts of the rows of a mask.

        Args:
            key: keys of the episodes that begin, int64 [N].
            following: keys of the episodes after the present ones, int64 [N].
            mask: rows whose episodes begin, bool [N].

        Returns:
            Positions [B, 1 + M, 2] of the B rows of `mask`.

        Raises:
            LayoutError: naming the object that did not fit.
        """
        if self._lacks(key)[mask].any():
            wanted = torch.where(mask, key, following)
            missing = self._lacks(wanted)
            try:
                self._remember(wanted, missing)
            except LayoutError:
                # perhaps there is none for an episode that never comes
                self._remember(wanted, missing & mask)
        return self._layouts[mask]

    def _lacks(self, key: Tensor) -> Tensor:
        return (self._keys != key) | ~self._known

    def _remember(self, key: Tensor, rows: Tensor) -> None:
        self._layouts[rows] = self._draw(key[rows])
        self._keys[rows], self._known[rows] = key[rows], True
