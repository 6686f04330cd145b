"""Data collection with cost accounting."""

from safe_rl.collectors.accounting import EpisodeAccounting, EpisodeStatistics
from safe_rl.collectors.factory import make_collector
from safe_rl.collectors.workers import (
    WorkerCollector,
    make_process_collector,
    make_ray_collector,
)

__all__ = [
    "EpisodeAccounting",
    "EpisodeStatistics",
    "WorkerCollector",
    "make_collector",
    "make_process_collector",
    "make_ray_collector",
]
