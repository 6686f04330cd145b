"""Policy losses of PPO, RCPO, TRPO and CPO."""

from __future__ import annotations

from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential
from torch import Tensor

from safe_rl.checks import Fraction
from safe_rl.objectives.surrogate import SurrogateLoss, WeighsCosts


def clipped_gain(log_weight: Tensor, advantage: Tensor, clip_epsilon: Tensor) -> Tensor:
    """min(ρA, clip(ρ, 1 − ε, 1 + ε)A), [..., 1], of log ρ (Schulman et al. 2017, equation 7)."""
    ratio = log_weight.exp()
    return torch.minimum(
        ratio * advantage, ratio.clamp(1 - clip_epsilon, 1 + clip_epsilon) * advantage
    )


class PPOLoss(SurrogateLoss):
    """Clipped policy loss of PPO (Schulman et al. 2017), without constraints.

    It differs from `torchrl.objectives.ClipPPOLoss` in two points: critics have a separate
    `CriticLoss`, and ``kl`` is the exact mean KL(π_θ ‖ π_k), for early stopping. It also reports
    ``clip_fraction``.

    Args:
        actor_network: Policy with `get_dist`; see `SurrogateLoss`.
        clip_epsilon: Half-width ε of the range to which ratios are clipped.
        settings: Those of every policy loss, see `SurrogateLoss`.

    Examples:
        >>> from tensordict import TensorDict
        >>> from safe_rl.models import make_actor
        >>> actor = make_actor(3, 2, hidden_sizes=[8], initial_log_std=-0.5)
        >>> with torch.no_grad():
        ...     batch = actor(TensorDict(observation=torch.randn(8, 3), batch_size=[8]))
        >>> batch["advantage"] = torch.randn(8, 1)
        >>> PPOLoss(actor, clip_epsilon=0.2, entropy_coeff=0.0)(batch)["kl"]
        tensor(0.)
    """

    extra_out_keys: tuple[str, ...] = ("clip_fraction",)
    _schedulable_buffers = frozenset({"clip_epsilon"})

    clip_epsilon: Tensor

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        *,
        clip_epsilon: Fraction,
        **settings: Any,
    ) -> None:
        super().__init__(actor_network, **settings)
        self.register_coeff_buffer("clip_epsilon", clip_epsilon, device=self._default_device)

    def _surrogates(self, tensordict: TensorDictBase, log_weight: Tensor) -> dict[str, Tensor]:
        clipped = ((log_weight.detach().exp() - 1).abs() > self.clip_epsilon).to(log_weight.dtype)
        return {
            "loss_objective": -self._objective(tensordict, log_weight),
            "clip_fraction": self._reduce_loss(clipped, tensordict, reduction="mean"),
        }

    def _objective(self, tensordict: TensorDictBase, log_weight: Tensor) -> Tensor:
        """The objective that is maximised, per sample, [..., 1]."""
        advantage = self._advantage(tensordict, log_weight)
        gain = clipped_gain(log_weight, advantage, self.clip_epsilon)
        return self._lagrangian(tensordict, gain, log_weight.exp())


class PPOLagrangianLoss(WeighsCosts, PPOLoss):
    """PPO on the Lagrangian (Ray, Achiam and Amodei 2019, section 5.1), for k constraints.

    The objective is (L_r − Σᵢ λᵢ L_cᵢ) / (1 + Σᵢ λᵢ). ``cost_clipping`` says what is clipped:

    - ``"none"``: only the reward surrogate L_r; costs are E[ρA_c], as in the article. Then nothing
      bounds the influence of a few samples, and with a high λ early stopping ends updates after a
      few steps;
    - ``"pessimistic"``: also each cost surrogate, E[max(ρA_c, clip(ρ)A_c)], so that it is never
      below the unclipped one (Zhang et al. 2022, clipped costs).

    This loss never trains the multipliers: call ``multiplier.update(limits)`` once per epoch, with
    a `LimitState`.

    Args:
        parts: Actor, and a multiplier with one λ per column of ``cost_advantage``.
        cost_clipping: Whether the surrogates of costs are clipped.
        settings: Those of every clipped loss, see `PPOLoss`.

    Examples:
        >>> from safe_rl.models import make_actor
        >>> from safe_rl.objectives.multipliers import LagrangeMultiplier
        >>> actor = make_actor(3, 2, hidden_sizes=[8], initial_log_std=-0.5)
        >>> multiplier = LagrangeMultiplier({"cost": 25.0}, init=1.0, lr=0.05)
        >>> PPOLagrangianLoss(actor, multiplier, clip_epsilon=0.2, entropy_coeff=0.0).out_keys
        ['loss_objective', 'loss_entropy', 'clip_fraction', 'kl', 'entropy', 'ESS']
    """

    def __init__(
        self, *parts: Any, cost_clipping: Literal["none", "pessimistic"] = "none", **settings: Any
    ) -> None:
        super().__init__(*parts, **settings)
        self.cost_clipping = cost_clipping

    def _cost_gain(self, tensordict: TensorDictBase, ratio: Tensor) -> Tensor:
        if self.cost_clipping == "none":
            return super()._cost_gain(tensordict, ratio)
        cost_advantage = self._cost_advantage(tensordict)
        # the logarithm has an infinite slope at a ratio that has underflowed to 0
        log_weight = ratio.clamp_min(torch.finfo(ratio.dtype).tiny).log()
        return -clipped_gain(log_weight, -cost_advantage, self.clip_epsilon)


class RCPOLoss(WeighsCosts, PPOLoss):
    """PPO on the penalised reward r − Σᵢ λᵢ cᵢ (Tessler et al. 2019, definition 3).

    Its advantage is Â = A − Σᵢ λᵢ A_cᵢ, from the critics of reward and costs. A single critic, of
    r − λc, would lag behind changes of λ. The objective is clipped as a whole, min(ρÂ, clip(ρ)Â).
    The multiplier should change slowly (the third time scale of the article). Arguments are a
    multiplier, with one λ per column of ``cost_advantage``, and those of `PPOLoss`.

    Examples:
        >>> from safe_rl.models import make_actor
        >>> from safe_rl.objectives import ProjectedMultiplier
        >>> actor = make_actor(3, 2, hidden_sizes=[16], initial_log_std=-0.5)
        >>> multiplier = ProjectedMultiplier({"cost": 25.0}, init=0.0, lr=0.001, highest=None)
        >>> RCPOLoss(actor, multiplier, clip_epsilon=0.2, entropy_coeff=0.0).has_costs
        True
    """

    def _objective(self, tensordict: TensorDictBase, log_weight: Tensor) -> Tensor:
        advantage = self._penalised_advantage(tensordict, log_weight)
        return clipped_gain(log_weight, advantage, self.clip_epsilon)


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
        >>> TRPOLagrangianLoss(actor, multiplier, entropy_coeff=0.0).has_costs
        True
    """


class CPOLoss(SurrogateLoss):
    """Surrogates of CPO: ``loss_objective`` = −E[ρ A] and ``cost_surrogate`` = E[ρ A_c], [k].

    Both have gradients. The cost surrogates are constraints, not losses: a
    `safe_rl.algorithms.CPOStep` keeps them within their limits. They are means over the samples for
    any ``reduction``. Arguments are those of `SurrogateLoss`.

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
        return {
            "loss_objective": -ratio * self._advantage(tensordict, log_weight),
            "cost_surrogate": self._cost_surrogates(
                tensordict, ratio * self._cost_advantage(tensordict)
            ),
        }
