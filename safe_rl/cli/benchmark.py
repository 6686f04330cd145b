"""The benchmark's environments as what a run's configuration is compared with."""

from __future__ import annotations

from safe_rl.envs.safety_gym.suite import SUITE, group_node, resolve
from safe_rl.scores.benchmark import Suite

__all__ = ["suite"]


def suite() -> Suite:
    """All environments of the suite, every key of each."""
    nodes = {name: group_node(name, config) for name, config in SUITE.items()}
    return Suite(nodes, group_node("", resolve({})))
