"""Random numbers as a pure function of integers, for batches whose rows must not share a stream.

Every row of a batch has its own seed. A draw is identified by its use (episode, purpose, attempt,
object, …) instead of by the number of earlier draws. So row k does not depend on the batch size,
the other rows or the thread count, and a saved state needs no generator state. Generators of
libraries have one stream each. One generator per row would need a loop over rows in every reset.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

# SplitMix64 (Steele, Lea, Flood 2014), as two's complement int64.
_GAMMA = 0x9E3779B97F4A7C15 - (1 << 64)
_MIX_1 = 0xBF58476D1CE4E5B9 - (1 << 64)
_MIX_2 = 0x94D049BB133111EB - (1 << 64)


def _shift_right(x: Tensor, bits: int) -> Tensor:
    """Shift int64 right, filling with zeros (torch's own shift repeats the sign bit)."""
    return (x >> bits).bitwise_and_((1 << (64 - bits)) - 1)


def fold(key: Tensor, *counters: Tensor | int) -> Tensor:
    """Hash int64 keys with counters, one after the other, into int64 keys of the broadcast shape.

    The new keys are uniform over all 64-bit values.

    Examples:
        >>> fold(torch.tensor([1, 1]), torch.tensor([0, 0])).unique().numel()
        1
    """
    for counter in counters:
        # multiplied by an odd constant, so that neighbours differ in many bits
        spread = counter * _MIX_2
        if isinstance(spread, int):  # as int64
            spread = (spread + (1 << 63)) % (1 << 64) - (1 << 63)
        key = (key ^ spread).add_(_GAMMA)
        key.bitwise_xor_(_shift_right(key, 30)).mul_(_MIX_1)
        key.bitwise_xor_(_shift_right(key, 27)).mul_(_MIX_2)
        key.bitwise_xor_(_shift_right(key, 31))
    return key


def uniform(key: Tensor, *counters: Tensor | int) -> Tensor:
    """Return float64 draws in [0, 1), one for each of the keys `fold(key, *counters)`."""
    return _shift_right(fold(key, *counters), 11).to(torch.float64).mul_(2.0**-53)


def normal(key: Tensor, *counters: Tensor | int) -> Tensor:
    """Return float64 standard normal draws (Box-Muller), one for each folded key."""
    radius = torch.sqrt(-2.0 * torch.log1p(-uniform(key, *counters, 0)))
    return radius * torch.cos(2.0 * math.pi * uniform(key, *counters, 1))


def row_seeds(seed: int, num_rows: int, device: torch.device | None = None) -> Tensor:
    """Return one seed per row, int64 [num_rows]; row k is the same for every `num_rows`."""
    rows = torch.arange(num_rows, device=device)
    return fold(torch.full_like(rows, seed), rows)


class DrawnAhead:
    """Draws of N rows by their keys, made in advance and stored until they are needed.

    A draw depends only on its key, and to make one takes about as long as to make a hundred. So
    when a row begins an episode, those for the next episodes of the other rows are made too. They
    need not be part of a saved state.

    Args:
        draw: Makes the draws of keys, int64 [B] -> [B, …]; raises a ValueError if there is none for
            one of the keys.
        shape: N, …
        device: Device of the keys.
    """

    def __init__(
        self,
        draw: Callable[[Tensor], Tensor],
        shape: Sequence[int],
        device: torch.device | None = None,
    ) -> None:
        self._draw = draw
        self._known = torch.zeros(shape[0], dtype=torch.bool, device=device)
        self._keys = torch.zeros(shape[0], dtype=torch.int64, device=device)
        self._drawn = torch.zeros(*shape, dtype=torch.float64, device=device)

    def __call__(self, key: Tensor, following: Tensor, mask: Tensor) -> Tensor:
        """Return draws [N, …] that are valid in the rows of a mask.

        Args:
            key: Keys of the draws of the present episodes, int64 [N].
            following: Keys of those of the next episodes, int64 [N].
            mask: Rows that begin an episode, bool [N].
        """
        if (((self._keys != key) | ~self._known) & mask).any():
            wanted = torch.where(mask, key, following)
            rows = (self._keys != wanted) | ~self._known
            try:
                drawn = self._draw(wanted[rows])
            except ValueError:
                # The missing draw may be that of a next episode, which perhaps never begins.
                rows &= mask
                drawn = self._draw(wanted[rows])
            self._drawn[rows], self._keys[rows], self._known[rows] = drawn, wanted[rows], True
        return self._drawn


def spread_seed(seed: int) -> int:
    """Return a 32-bit seed for a library that seeds its rows with this number and the next ones.

    Neighbouring seeds are spread, so that their ranges of row seeds do not overlap.

    Examples:
        >>> abs(spread_seed(1) - spread_seed(0)) > 1000
        True
    """
    return int(np.random.SeedSequence(seed).generate_state(1)[0])
