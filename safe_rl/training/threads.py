"""How many threads step the physics."""

from __future__ import annotations

import os

from omegaconf import DictConfig

__all__ = ["physics_threads"]


def physics_threads(config: DictConfig) -> int:
    """Threads that step each environment; 0 is one per core. Workers share them."""
    num_collectors = config.collector.num_collectors
    if num_collectors == 1:
        return config.num_threads or 0
    return max(1, (config.num_threads or os.cpu_count() or 1) // num_collectors)
