"""Data collection with cost accounting."""

from safe_rl.collectors.episodes import EpisodeAccounting, EpisodeStatistics
from safe_rl.collectors.factory import make_collector

__all__ = ["EpisodeAccounting", "EpisodeStatistics", "make_collector"]
