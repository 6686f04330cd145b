"""Losses of trust-region steps: TRPO, its Lagrangian, and CPO."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from safe_rl.objectives.surrogate import SurrogateLoss, WeighsCosts


class TRPOLoss(SurrogateLoss):
    """Unclipped policy loss −E[ρ A] (Schulman et al. 2015, equation 14), without constraints.

    A `safe_rl.algorithms.TRPOStep` minimises it within a trust region; with an optimiser it is the
    plain importance-weighted policy gradient. Arguments are those of `SurrogateLoss`.

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


class TRPOLagrangianLoss(WeighsCosts, TRPOLoss):
    """`TRPOLoss` on the Lagrangian (L_r − Σᵢ λᵢ L_cᵢ) / (1 + Σᵢ λᵢ), for k constraints.

    Arguments are a multiplier, one λ per column of ``cost_advantage``, and those of `TRPOLoss`.

    Examples:
        >>> from safe_rl.objectives.multipliers import LagrangeMultiplier
        >>> from safe_rl.models import make_actor
        >>> actor = make_actor(3, 2, hidden_sizes=[8], initial_log_std=-0.5)
        >>> multiplier = LagrangeMultiplier({"cost": 25.0}, init=1.0, lr=0.05)
        >>> "cost_advantage" in TRPOLagrangianLoss(actor, multiplier, entropy_coeff=0.0).in_keys
        True
    """


class CPOLoss(SurrogateLoss):
    """Surrogates of CPO: ``loss_objective`` = −E[ρ A] and ``cost_surrogate`` = E[ρ A_c], [k].

    Both carry gradients. The cost surrogates are constraints, not losses: a
    `safe_rl.algorithms.CPOStep` keeps them within their limits. Arguments are those of
    `SurrogateLoss`; a step needs the mean over the samples.

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
