"""Constrained reinforcement learning on TorchRL.

`safe_rl.envs` holds the environments, `safe_rl.objectives` the constrained losses and
solvers, `safe_rl.collectors` data collection with cost accounting.
"""

__version__ = "0.1.0"
