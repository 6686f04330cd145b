"""The benchmark's environments as what a run's configuration is compared with."""

from __future__ import annotations

from safe_rl.envs.families import config_node
from safe_rl.envs.safety_gym.suite import SUITE, resolve
from safe_rl.scores.benchmark import Suite

__all__ = ["suite"]


def suite() -> Suite:
    """All environments of the suite, every key of each."""
    nodes = {name: config_node(name, config) for name, config in SUITE.items()}
    return Suite(nodes, config_node("", resolve({})))
