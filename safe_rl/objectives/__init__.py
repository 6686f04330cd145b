"""Losses of constrained algorithms, advantage estimators and Lagrange multipliers.

They read and write entries of TensorDicts, and do not depend on an environment.
"""

from safe_rl.objectives.advantages import CostGAE, JointAdvantages, VectorGAE
from safe_rl.objectives.cost_values import CostValues, GaussianCosts, MeanCosts, QuantileCosts
from safe_rl.objectives.critics import ActorCriticLoss, CriticLoss
from safe_rl.objectives.deterministic_losses import BCLoss, TD3LagrangianLoss, TD3Loss
from safe_rl.objectives.gae import normalise_advantages
from safe_rl.objectives.limits import LimitState, LimitTracker
from safe_rl.objectives.multipliers import (
    LagrangeMultiplier,
    Multiplier,
    PIDMultiplier,
    PIMultiplier,
    ProjectedMultiplier,
)
from safe_rl.objectives.penalties import APPOLoss, IPOLoss, P3OLoss
from safe_rl.objectives.policy_losses import (
    CPOLoss,
    PPOLagrangianLoss,
    PPOLoss,
    RCPOLoss,
    TRPOLagrangianLoss,
    TRPOLoss,
)
from safe_rl.objectives.policy_projections import CUPLoss, FOCOPSLoss
from safe_rl.objectives.risk import Chance, CVaR, RiskMeasure
from safe_rl.objectives.sac import CALLoss, SACLagrangianLoss, SACLoss
from safe_rl.objectives.surrogate import SurrogateLoss

__all__ = [
    "APPOLoss",
    "ActorCriticLoss",
    "BCLoss",
    "CALLoss",
    "CPOLoss",
    "CUPLoss",
    "CVaR",
    "Chance",
    "CostGAE",
    "CostValues",
    "CriticLoss",
    "FOCOPSLoss",
    "GaussianCosts",
    "IPOLoss",
    "JointAdvantages",
    "LagrangeMultiplier",
    "LimitState",
    "LimitTracker",
    "MeanCosts",
    "Multiplier",
    "P3OLoss",
    "PIDMultiplier",
    "PIMultiplier",
    "PPOLagrangianLoss",
    "PPOLoss",
    "ProjectedMultiplier",
    "QuantileCosts",
    "RCPOLoss",
    "RiskMeasure",
    "SACLagrangianLoss",
    "SACLoss",
    "SurrogateLoss",
    "TD3LagrangianLoss",
    "TD3Loss",
    "TRPOLagrangianLoss",
    "TRPOLoss",
    "VectorGAE",
    "normalise_advantages",
]
