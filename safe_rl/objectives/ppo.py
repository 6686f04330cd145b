"""Proximal policy optimisation, with and without constraints."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential
from torch import Tensor

from safe_rl.objectives.multipliers import Multiplier
from safe_rl.objectives.surrogate import SurrogateLoss, require_multiplier


def clipped_gain(log_weight: Tensor, advantage: Tensor, clip_epsilon: Tensor) -> Tensor:
    """min(ρA, clip(ρ, 1 − ε, 1 + ε)A) (Schulman et al. 2017, equation 7).

    Args:
        log_weight: log ρ, [..., 1].
        advantage: A, [..., 1].
        clip_epsilon: ε, scalar.

    Returns:
        Per-sample gain, [..., 1].
    """
    ratio = log_weight.exp()
    return torch.minimum(
        ratio * advantage, ratio.clamp(1 - clip_epsilon, 1 + clip_epsilon) * advantage
    )


class PPOLoss(SurrogateLoss):
    """Clipped policy loss of PPO (Schulman et al. 2017), without constraints.

    Differs from `torchrl.objectives.ClipPPOLoss` in that critics are not its business (see
    `CriticLoss`) and that ``kl`` is the exact mean KL(π_θ ‖ π_k), by which early stopping can
    be decided. See `SurrogateLoss` for what it reads and writes; adds ``clip_fraction``.

    Args:
        actor_network: policy with `get_dist`; see `SurrogateLoss`.
        clip_epsilon: half-width ε of the interval within which a ratio earns.
        entropy_coeff: factor of the entropy bonus.
        reduction: ``"mean"``, ``"sum"`` or ``"none"``.

    Examples:
        >>> import torch
        >>> from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
        >>> from torchrl.modules import IndependentNormal, ProbabilisticActor
        >>> from tensordict import TensorDict
        >>> net = torch.nn.Sequential(torch.nn.Linear(3, 2), AddStateIndependentNormalScale(2))
        >>> actor = ProbabilisticActor(
        ...     TensorDictModule(net, in_keys=["observation"], out_keys=["loc", "scale"]),
        ...     in_keys=["loc", "scale"],
        ...     distribution_class=IndependentNormal,
        ...     return_log_prob=True,
        ... )
        >>> with torch.no_grad():
        ...     batch = actor(TensorDict(observation=torch.randn(8, 3), batch_size=[8]))
        >>> batch["advantage"] = torch.randn(8, 1)
        >>> loss = PPOLoss(actor, clip_epsilon=0.2, entropy_coeff=0.0)
        >>> loss(batch)["kl"]
        tensor(0.)
    """

    extra_out_keys = ("clip_fraction",)
    _schedulable_buffers = frozenset({"clip_epsilon"})

    clip_epsilon: Tensor

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        *,
        clip_epsilon: float,
        entropy_coeff: float,
        reduction: str = "mean",
        multiplier: Multiplier | None = None,
    ) -> None:
        super().__init__(
            actor_network, entropy_coeff=entropy_coeff, multiplier=multiplier, reduction=reduction
        )
        self.register_coeff_buffer("clip_epsilon", clip_epsilon, device=self._default_device)

    def _surrogates(self, tensordict: TensorDictBase, log_weight: Tensor) -> dict[str, Tensor]:
        advantage = self._advantage(tensordict, log_weight)
        gain = clipped_gain(log_weight, advantage, self.clip_epsilon)
        ratio = log_weight.exp()
        clipped = (ratio.detach() - 1).abs() > self.clip_epsilon
        return {
            "loss_objective": -self._lagrangian(tensordict, gain, ratio),
            "clip_fraction": self._reduce_loss(
                clipped.to(ratio.dtype), tensordict, reduction="mean"
            ),
        }


class PPOLagrangianLoss(PPOLoss):
    """PPO on the Lagrangian (Ray, Achiam and Amodei 2019, section 5.1), for k constraints.

    The objective is (L_r − Σᵢ λᵢ L_cᵢ) / (1 + Σᵢ λᵢ). Only the reward surrogate L_r is clipped:
    clipping a cost surrogate would stop its gradient where the policy most needs it. The
    multipliers are read at every call and never trained by this loss: call
    ``multiplier.update(mean_costs)`` once per epoch.

    Args:
        actor_network: policy with `get_dist`; see `SurrogateLoss`.
        multiplier: one λ per column of ``cost_advantage``.
        clip_epsilon: half-width ε of the interval within which a ratio earns.
        entropy_coeff: factor of the entropy bonus.
        reduction: ``"mean"``, ``"sum"`` or ``"none"``.

    Raises:
        TypeError: if there is no multiplier.

    Examples:
        >>> import torch
        >>> from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
        >>> from torchrl.modules import IndependentNormal, ProbabilisticActor
        >>> from safe_rl.objectives.multipliers import LagrangeMultiplier
        >>> net = torch.nn.Sequential(torch.nn.Linear(3, 2), AddStateIndependentNormalScale(2))
        >>> actor = ProbabilisticActor(
        ...     TensorDictModule(net, in_keys=["observation"], out_keys=["loc", "scale"]),
        ...     in_keys=["loc", "scale"],
        ...     distribution_class=IndependentNormal,
        ... )
        >>> multiplier = LagrangeMultiplier({"cost": 25.0}, init=1.0, lr=0.05)
        >>> loss = PPOLagrangianLoss(actor, multiplier, clip_epsilon=0.2, entropy_coeff=0.0)
        >>> loss.out_keys
        ['loss_objective', 'loss_entropy', 'clip_fraction', 'kl', 'entropy', 'ESS']
    """

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        multiplier: Multiplier,
        *,
        clip_epsilon: float,
        entropy_coeff: float,
        reduction: str = "mean",
    ) -> None:
        super().__init__(
            actor_network,
            clip_epsilon=clip_epsilon,
            entropy_coeff=entropy_coeff,
            reduction=reduction,
            multiplier=require_multiplier(multiplier, "PPOLoss"),
        )
