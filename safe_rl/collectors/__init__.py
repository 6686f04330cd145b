"""Data collection with cost accounting, and transitions on disk."""

from safe_rl.collectors.accounting import EpisodeAccounting, EpisodeError, EpisodeStatistics
from safe_rl.collectors.datasets import read_dataset, read_hdf5, safe_episodes
from safe_rl.collectors.factory import make_collector, make_process_collector, make_ray_collector
from safe_rl.collectors.recording import (
    Recording,
    StepRecorder,
    describe_env,
    read_action_bounds,
    read_recording,
)
from safe_rl.collectors.workers import WorkerCollector, WorkerError

__all__ = [
    "EpisodeAccounting",
    "EpisodeError",
    "EpisodeStatistics",
    "Recording",
    "StepRecorder",
    "WorkerCollector",
    "WorkerError",
    "describe_env",
    "make_collector",
    "make_process_collector",
    "make_ray_collector",
    "read_action_bounds",
    "read_dataset",
    "read_hdf5",
    "read_recording",
    "safe_episodes",
]
