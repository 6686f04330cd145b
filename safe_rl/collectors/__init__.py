"""Data collection with cost accounting, and transitions on disk."""

from safe_rl.collectors.accounting import (
    EpisodeAccounting,
    EpisodeError,
    EpisodeStatistics,
    check_steps,
)
from safe_rl.collectors.building import make_collector, make_process_collector, make_ray_collector
from safe_rl.collectors.datasets import (
    read_columns,
    read_dataset,
    read_hdf5,
    safe_episodes,
    safety_gymnasium_columns,
)
from safe_rl.collectors.recording import Recording, StepRecorder, match_columns, read_recording
from safe_rl.collectors.workers import WorkerCollector, WorkerError

__all__ = [
    "EpisodeAccounting",
    "EpisodeError",
    "EpisodeStatistics",
    "Recording",
    "StepRecorder",
    "WorkerCollector",
    "WorkerError",
    "check_steps",
    "make_collector",
    "make_process_collector",
    "make_ray_collector",
    "match_columns",
    "read_columns",
    "read_dataset",
    "read_hdf5",
    "read_recording",
    "safe_episodes",
    "safety_gymnasium_columns",
]
