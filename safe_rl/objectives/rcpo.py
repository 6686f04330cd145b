"""Reward-constrained policy optimisation (Tessler, Mankowitz and Mannor 2019)."""

from __future__ import annotations

from typing import Any

from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential
from torch import Tensor

from safe_rl.objectives.multipliers import Multiplier
from safe_rl.objectives.ppo import PPOLoss
from safe_rl.objectives.surrogate import require_multiplier


class RCPOLoss(PPOLoss):
    """PPO on the penalised reward r − Σᵢ λᵢ cᵢ (Tessler et al. 2019, definition 3).

    Advantages are linear in what they are of: that of the penalised reward is A − Σᵢ λᵢ A_cᵢ, and
    its value is told by the reward's and the costs' critics together, without the lag that a
    critic of r − λc has behind λ. It is clipped as a whole, min(ρÂ, clip(ρ)Â). λ is a multiplier
    that moves slowly, on the third time scale: policy and critics see it stand still.

    Args:
        actor_network: policy with `get_dist`; see `SurrogateLoss`.
        multiplier: one λ per column of ``cost_advantage``, read at every call.
        settings: Those of every clipped loss, see `PPOLoss`.

    Raises:
        TypeError: if there is no multiplier.

    Examples:
        >>> from safe_rl.models import make_actor
        >>> from safe_rl.objectives import ProjectedMultiplier
        >>> actor = make_actor(3, 2, hidden_sizes=[16], initial_log_std=-0.5)
        >>> multiplier = ProjectedMultiplier({"cost": 25.0}, init=0.0, lr=0.001, highest=None)
        >>> loss = RCPOLoss(actor, multiplier, clip_epsilon=0.2, entropy_coeff=0.0)
        >>> "cost_advantage" in loss.in_keys
        True
    """

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        multiplier: Multiplier,
        **settings: Any,
    ) -> None:
        super().__init__(actor_network, **settings)
        self.multiplier = require_multiplier(multiplier, "PPOLoss")

    def _advantage(self, tensordict: TensorDictBase, log_weight: Tensor) -> Tensor:
        return self._penalised_advantage(tensordict, log_weight)

    def _lagrangian(self, tensordict: TensorDictBase, reward_gain: Tensor, ratio: Tensor) -> Tensor:
        return reward_gain  # the costs are in the advantage already
