"""Constrained losses, advantages and multipliers.

Everything here works on TensorDict keys alone and knows no environment:

- `VectorGAE`, `CostGAE`, `normalise_advantages`: advantages of the reward and of k costs;
- `LagrangeMultiplier`, `PIDMultiplier`, `PIMultiplier`, `ProjectedMultiplier`: one λ per cost,
  moved by the mean episode costs;
- `LimitTracker`: from the costs of a batch to how far J_c is from where it should be by now;
- `CVaR`, `Chance`: limits on the worst episodes, or on how many cost too much;
- `PPOLoss`, `PPOLagrangianLoss`, `RCPOLoss`, `P3OLoss`, `IPOLoss`, `FOCOPSLoss`, `CUPLoss`:
  policy losses for an optimiser;
- `TRPOLoss`, `TRPOLagrangianLoss`, `CPOLoss`: policy losses for the steps of `safe_rl.algorithms`,
  whose mathematics is in `safe_rl.objectives.trust_region` and `safe_rl.objectives.cpo_dual`;
- `SACLoss`, `SACLagrangianLoss`, `WCSACLoss`, `CALLoss`, `TD3Loss`, `TD3LagrangianLoss`: losses on
  steps from a replay buffer;
- `BCLoss`: behaviour cloning;
- `CriticLoss`: squared errors of the reward and the cost critic;
- `ActorCriticLoss`, `JointAdvantages`: all losses and estimators as one, for TorchRL's trainers.
"""

from safe_rl.objectives.actor_critic import ActorCriticLoss, JointAdvantages
from safe_rl.objectives.advantages import CostGAE, VectorGAE
from safe_rl.objectives.bc import BCLoss
from safe_rl.objectives.cal import CALLoss
from safe_rl.objectives.controllers import PIDMultiplier, PIMultiplier
from safe_rl.objectives.critics import CriticLoss
from safe_rl.objectives.gae import normalise_advantages
from safe_rl.objectives.limits import LimitTracker
from safe_rl.objectives.multipliers import LagrangeMultiplier, Multiplier, ProjectedMultiplier
from safe_rl.objectives.penalties import IPOLoss, P3OLoss
from safe_rl.objectives.policy_projections import CUPLoss, FOCOPSLoss
from safe_rl.objectives.ppo import PPOLagrangianLoss, PPOLoss, RCPOLoss
from safe_rl.objectives.risk import Chance, CVaR, RiskMeasure
from safe_rl.objectives.sac import SACLagrangianLoss, SACLoss
from safe_rl.objectives.surrogate import SurrogateLoss
from safe_rl.objectives.td3 import TD3LagrangianLoss, TD3Loss
from safe_rl.objectives.trpo import CPOLoss, TRPOLagrangianLoss, TRPOLoss
from safe_rl.objectives.wcsac import WCSACLoss

__all__ = [
    "ActorCriticLoss",
    "BCLoss",
    "CALLoss",
    "CPOLoss",
    "CUPLoss",
    "CVaR",
    "Chance",
    "CostGAE",
    "CriticLoss",
    "FOCOPSLoss",
    "IPOLoss",
    "JointAdvantages",
    "LagrangeMultiplier",
    "LimitTracker",
    "Multiplier",
    "P3OLoss",
    "PIDMultiplier",
    "PIMultiplier",
    "PPOLagrangianLoss",
    "PPOLoss",
    "ProjectedMultiplier",
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
    "WCSACLoss",
    "normalise_advantages",
]
