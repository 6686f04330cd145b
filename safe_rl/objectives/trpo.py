"""Losses of trust-region steps: TRPO, its Lagrangian, and CPO."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential
from torch import Tensor

from safe_rl.objectives.multipliers import Multiplier
from safe_rl.objectives.surrogate import SurrogateLoss, require_multiplier


class TRPOLoss(SurrogateLoss):
    """Unclipped policy loss −E[ρ A] (Schulman et al. 2015, equation 14), without constraints.

    See `SurrogateLoss` for what it reads and writes. A `safe_rl.algorithms.TRPOStep`
    minimises it within a trust region; with an optimiser of your own it is the plain
    importance-weighted policy gradient.

    Args:
        actor_network: policy with `get_dist`; see `SurrogateLoss`.
        entropy_coeff: Factor of the entropy bonus.
        reduction: How samples are reduced; ``"none"`` keeps them, which no update takes.

    Examples:
        >>> from safe_rl.models import make_actor
        >>> actor = make_actor(3, 2, hidden_sizes=[8], initial_log_std=-0.5)
        >>> TRPOLoss(actor, entropy_coeff=0.0).out_keys
        ['loss_objective', 'loss_entropy', 'kl', 'entropy', 'ESS']
    """

    def _surrogates(self, tensordict: TensorDictBase, log_weight: Tensor) -> dict[str, Tensor]:
        ratio = log_weight.exp()
        gain = ratio * self._advantage(tensordict, log_weight)
        return {"loss_objective": -self._lagrangian(tensordict, gain, ratio)}


class TRPOLagrangianLoss(TRPOLoss):
    """`TRPOLoss` on the Lagrangian (L_r − Σᵢ λᵢ L_cᵢ) / (1 + Σᵢ λᵢ), for k constraints.

    Args:
        actor_network: policy with `get_dist`; see `SurrogateLoss`.
        multiplier: one λ per column of ``cost_advantage``, read at every call.
        settings: Those of every policy loss, see `SurrogateLoss`.

    Raises:
        TypeError: if there is no multiplier.

    Examples:
        >>> from safe_rl.objectives.multipliers import LagrangeMultiplier
        >>> from safe_rl.models import make_actor
        >>> actor = make_actor(3, 2, hidden_sizes=[8], initial_log_std=-0.5)
        >>> multiplier = LagrangeMultiplier({"cost": 25.0}, init=1.0, lr=0.05)
        >>> "cost_advantage" in TRPOLagrangianLoss(actor, multiplier, entropy_coeff=0.0).in_keys
        True
    """

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        multiplier: Multiplier,
        **settings: Any,
    ) -> None:
        super().__init__(actor_network, **settings)
        self.multiplier = require_multiplier(multiplier, "TRPOLoss")


class CPOLoss(SurrogateLoss):
    """Surrogates of CPO: ``loss_objective`` = −E[ρ A] and ``cost_surrogate`` = E[ρ A_c], [k].

    Both carry gradients. The cost surrogates are constraints, not losses: a
    `safe_rl.algorithms.CPOStep` keeps them within their limits; with an optimiser of your own,
    combine them as you see fit. See `SurrogateLoss` for what it reads and writes.

    Args:
        actor_network: policy with `get_dist`; see `SurrogateLoss`.
        entropy_coeff: Factor of the entropy bonus.
        reduction: ``"mean"``, ``"sum"`` or ``"none"`` over the samples; a `CPOStep` needs the mean.

    Examples:
        >>> from safe_rl.models import make_actor
        >>> actor = make_actor(3, 2, hidden_sizes=[8], initial_log_std=-0.5)
        >>> CPOLoss(actor, entropy_coeff=0.0).out_keys
        ['loss_objective', 'loss_entropy', 'cost_surrogate', 'kl', 'entropy', 'ESS']
    """

    extra_out_keys = ("cost_surrogate",)
    has_costs = True

    def _surrogates(self, tensordict: TensorDictBase, log_weight: Tensor) -> dict[str, Tensor]:
        ratio = log_weight.exp()
        costs = (ratio * self._cost_advantage(tensordict)).unbind(-1)
        return {
            "loss_objective": -ratio * self._advantage(tensordict, log_weight),
            "cost_surrogate": torch.stack([self._reduce_loss(cost, tensordict) for cost in costs]),
        }
