"""Algorithms: gradient updates, trust-region steps, and how they are built."""

from safe_rl.algorithms.algorithm_contract import Algorithm, PolicyUpdate
from safe_rl.algorithms.constraints import Constraints
from safe_rl.algorithms.cpo_step import CPOStep, PCPOStep
from safe_rl.algorithms.minibatch import CUPUpdate, KLAdaptiveRate, MinibatchUpdate
from safe_rl.algorithms.off_policy import OffPolicy
from safe_rl.algorithms.on_policy import OnPolicy
from safe_rl.algorithms.processor_use import fast_products
from safe_rl.algorithms.recovery_steps import CRPOStep, CTRPOStep
from safe_rl.algorithms.replay_buffer import Memory
from safe_rl.algorithms.replay_update import ReplayUpdate
from safe_rl.algorithms.trust_region_step import TRPOStep

__all__ = [
    "Algorithm",
    "CPOStep",
    "CRPOStep",
    "CTRPOStep",
    "CUPUpdate",
    "Constraints",
    "KLAdaptiveRate",
    "Memory",
    "MinibatchUpdate",
    "OffPolicy",
    "OnPolicy",
    "PCPOStep",
    "PolicyUpdate",
    "ReplayUpdate",
    "TRPOStep",
    "fast_products",
]
