"""Addressed random numbers: uniform, normal, and unrelated between neighbouring addresses."""

import numpy as np
import pytest
import torch
from scipy import stats

from safe_rl.envs import rng

NUM = 20_000
UNLIKELY = 1e-3  # p values below this one would be a finding
COUNTER = torch.arange(NUM)


def test_fold_is_splitmix64():
    """The first outputs of `splitmix64.c` (Vigna) for the state 1234567."""
    mask, gamma = (1 << 64) - 1, 0x9E3779B97F4A7C15
    published = [6457827717110365317, 3203168211198807973, 9817491932198370423]
    for index, want in enumerate(published):
        state = (1234567 + index * gamma) & mask
        key = torch.tensor(state - (1 << 64) if state >> 63 else state)
        assert int(rng.fold(key, 0)) & mask == want


# Neighbours in every part of an address: rows, episodes, purposes, attempts.
ADDRESSES = {
    "counter": lambda: rng.uniform(torch.tensor(0), COUNTER),
    "key": lambda: rng.uniform(COUNTER, 0),
    "row": lambda: rng.uniform(rng.row_seeds(0, NUM), 1, 2),
    "seed": lambda: torch.cat([rng.uniform(rng.row_seeds(seed, 10), 0) for seed in range(2000)]),
    "middle": lambda: rng.uniform(torch.tensor(7), COUNTER, 3),
    "product": lambda: rng.uniform(COUNTER[:200, None], 5, COUNTER[:100]).flatten(),
}


@pytest.mark.parametrize("address", ADDRESSES)
def test_neighbouring_addresses_give_uniform_unrelated_numbers(address):
    draws = ADDRESSES[address]().numpy()
    assert draws.dtype == np.float64
    assert draws.min() >= 0
    assert draws.max() < 1
    assert stats.kstest(draws, stats.uniform.cdf).pvalue > UNLIKELY
    for lag in (1, 2, 10, 100):
        assert stats.spearmanr(draws[:-lag], draws[lag:]).pvalue > UNLIKELY
    bits = draws.copy()
    for _ in range(8):
        bits *= 2
        bit, bits = np.floor(bits), bits % 1
        assert stats.binomtest(int(bit.sum()), len(draws)).pvalue > UNLIKELY / 8
    cells = np.histogram2d(draws[::2], draws[1::2], bins=10, range=[[0, 1], [0, 1]])[0]
    assert stats.chisquare(cells.flatten()).pvalue > UNLIKELY


def test_normal_numbers():
    draws = rng.normal(torch.tensor(3), COUNTER).numpy()
    assert stats.kstest(draws, stats.norm.cdf).pvalue > UNLIKELY
    assert stats.spearmanr(draws[:-1], draws[1:]).pvalue > UNLIKELY
    assert stats.spearmanr(np.abs(draws[:-1]), np.abs(draws[1:])).pvalue > UNLIKELY


def test_counters_of_different_depth_are_different_addresses():
    key = torch.tensor(11)
    counters = ((0,), (1,), (0, 0), (0, 1), (1, 0))
    keys = torch.stack([rng.fold(key, *address) for address in counters])
    assert len(keys.unique()) == len(counters)
    assert len(rng.fold(key, COUNTER).unique()) == NUM
    assert torch.equal(rng.fold(key, 1, 2), rng.fold(rng.fold(key, 1), 2))


def test_rows_keep_their_seeds_in_larger_batches():
    assert torch.equal(rng.row_seeds(5, 3), rng.row_seeds(5, 100)[:3])
    together = torch.cat([rng.row_seeds(seed, 1000) for seed in range(5)])
    assert len(together.unique()) == 5000
