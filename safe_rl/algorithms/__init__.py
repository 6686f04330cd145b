"""What moves parameters: recipes, updates, trust-region steps, and building them."""

from safe_rl.algorithms.cpo_step import CPOStep
from safe_rl.algorithms.learning_rate import KLAdaptiveRate
from safe_rl.algorithms.minibatch import MinibatchUpdate, PolicyUpdate
from safe_rl.algorithms.trust_region_step import TRPOStep

__all__ = ["CPOStep", "KLAdaptiveRate", "MinibatchUpdate", "PolicyUpdate", "TRPOStep"]
