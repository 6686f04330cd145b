"""Losses that project an improved policy onto the policies of the network: FOCOPS and CUP."""

from __future__ import annotations

from typing import Annotated, Any

import torch
from annotated_types import Interval
from pydantic import PositiveFloat
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torch.distributions import Distribution
from torchrl.modules import set_recurrent_mode

from safe_rl.checks import Share, Weight
from safe_rl.objectives.distributions import has_closed_kl
from safe_rl.objectives.limits import LimitState
from safe_rl.objectives.samples import inputs_of
from safe_rl.objectives.surrogate import WeighsCosts


class FOCOPSLoss(WeighsCosts):
    """Loss of FOCOPS: KL divergence from the optimal policy within a trust region.

    Minimises (Zhang, Vuong and Ross 2020, from the gradient of their projection)

        E[1{KL(s) ≤ δ} (KL(s) − (1/β) ρ (A − Σᵢ νᵢ A_cᵢ))],  KL(s) = KL(π_θ ‖ π_k) in state s.

    Its minimum over all policies is π_k exp((A − Σᵢ νᵢ A_cᵢ)/β) / Z. This is the optimal policy
    within the trust region whose multipliers are β and ν. States with a KL above δ are ignored. The
    loss also reports ``trusted_fraction``, the share of the other states.

    Args:
        parts: Actor, and a multiplier with one ν per column of ``cost_advantage``; a
            `ProjectedMultiplier` in the article.
        temperature: Multiplier β of the trust region, named λ in the article.
        max_state_kl: KL divergence δ beyond which a state is ignored.
        settings: Those of every policy loss, see `SurrogateLoss`.

    Examples:
        >>> from safe_rl.models import make_actor
        >>> from safe_rl.objectives import ProjectedMultiplier
        >>> actor = make_actor(3, 2, hidden_sizes=[16], initial_log_std=-0.5)
        >>> multiplier = ProjectedMultiplier({"cost": 25.0}, init=0.0, lr=0.01, highest=2.0)
        >>> settings = {"max_state_kl": 0.02, "entropy_coeff": 0.0}
        >>> FOCOPSLoss(actor, multiplier, temperature=1.5, **settings).out_keys
        ['loss_objective', 'loss_entropy', 'trusted_fraction', 'kl', 'entropy', 'ESS']
    """

    extra_out_keys = ("trusted_fraction",)

    def __init__(
        self,
        *parts: Any,
        temperature: Annotated[float, Interval(ge=1e-9, le=1e9)],
        max_state_kl: PositiveFloat,
        **settings: Any,
    ) -> None:
        super().__init__(*parts, **settings)
        self.temperature, self.max_state_kl = temperature, max_state_kl

    def _evaluate(
        self, tensordict: TensorDictBase, log_weight: Tensor, divergence: Tensor
    ) -> dict[str, Tensor]:
        gain = log_weight.exp() * self._penalised_advantage(tensordict, log_weight)
        trusted = (divergence.detach() <= self.max_state_kl).to(gain)
        return {
            "loss_objective": trusted * (divergence - gain / self.temperature),
            "trusted_fraction": self._reduce_loss(trusted, tensordict, reduction="mean"),
        }


#: Key of the batch entries with the parameters of the policy that a projection starts from.
ANCHOR = "anchor"


class CUPLoss(WeighsCosts):
    """Loss of the second of CUP's two updates: the projection, which lowers the costs.

    The first update improves the policy for the reward by PPO's loss; its result is π½. The second
    update minimises this loss (Yang et al. 2022, their projection step),

        E[KL(π_θ ‖ π½) + h Σᵢ νᵢ ρ A_cᵢ],  ρ = π_θ/π_k,  h = (1 − γλ_GAE)/(1 − γ),

    with advantages of π_k, which collected the batch. h is from the article's bound for generalised
    advantage estimates. Here the loss is divided by 1 + h Σᵢ νᵢ, which does not change the minimum.
    Without this division, gradients grow with ν, and Adam's steps become so large that early
    stopping ends an update after two steps. `prepare` stores π½ in the batch. ``kl`` is
    KL(π_θ ‖ π½). The loss also reports the detached ``cost_surrogate`` [k], E[ρA_c].

    Args:
        parts: Actor, of a distribution whose KL has a closed form, and a multiplier with one ν per
            column of ``cost_advantage``; a `ProjectedMultiplier` in the article.
        gamma: Discount γ of the cost advantages.
        lmbda: Decay λ_GAE of the TD errors in the cost advantages.
        settings: Those of every policy loss, see `SurrogateLoss`.

    Raises:
        TypeError: When the loss is evaluated, if the KL has no closed form.
        KeyError: When the loss is evaluated, if the batch does not hold π½.

    Examples:
        >>> from safe_rl.models import make_actor
        >>> from safe_rl.objectives import ProjectedMultiplier
        >>> actor = make_actor(3, 2, hidden_sizes=[16], initial_log_std=-0.5)
        >>> multiplier = ProjectedMultiplier({"cost": 25.0}, init=0.5, lr=0.01, highest=2.0)
        >>> loss = CUPLoss(actor, multiplier, gamma=0.99, lmbda=0.97, entropy_coeff=0.0)
        >>> round(loss.cost_factor, 2)  # h
        3.97
    """

    extra_out_keys = ("cost_surrogate",)
    _behaviour_hint = "CUPLoss.prepare(batch, limits) writes it: call it after the first update."

    def __init__(self, *parts: Any, gamma: Weight, lmbda: Share, **settings: Any) -> None:
        super().__init__(*parts, **settings)
        self.cost_factor = (1 - gamma * lmbda) / (1 - gamma)

    @property
    def in_keys(self) -> list[NestedKey]:
        """Entries of the batch that are read; the advantage of the reward is not."""
        return [key for key in super().in_keys if key != self.tensor_keys.advantage]

    @property
    def behaviour_keys(self) -> dict[NestedKey, NestedKey]:
        """Keys of the parameters of π½ in the batch, from which ``kl`` is measured."""
        return {key: (ANCHOR, str(name)) for name, key in self._parameter_keys.items()}

    @torch.no_grad()
    def prepare(self, batch: TensorDictBase, limits: LimitState | None = None) -> TensorDictBase:
        """Write the current policy's parameters into a batch, as π½, and return the batch."""
        super().prepare(batch, limits)
        observed = inputs_of(self.actor_network, batch)
        actor, weights = self.actor_network, self.actor_network_params
        with weights.to_module(actor, preserve_module_state=False), set_recurrent_mode(True):
            parameters = actor.get_dist_params(observed)
        for name, key in self._parameter_keys.items():
            batch[ANCHOR, str(name)] = parameters.get(key).clone()
        return batch

    def _kl(
        self, tensordict: TensorDictBase, distribution: Distribution, log_weight: Tensor
    ) -> Tensor:
        if not has_closed_kl(distribution):
            raise TypeError(
                f"CUP projects in KL divergence, and that of {type(distribution).__name__} has no "
                "closed form: use a policy with Gaussian or categorical actions, or another algo."
            )
        return super()._kl(tensordict, distribution, log_weight)

    def _evaluate(
        self, tensordict: TensorDictBase, log_weight: Tensor, divergence: Tensor
    ) -> dict[str, Tensor]:
        gain = self._cost_gain(tensordict, log_weight.exp())
        penalty = (gain * self.multiplier.value).sum(-1, keepdim=True)
        scale = 1 + self.cost_factor * self.multiplier.value.sum()
        return {
            "loss_objective": (divergence + self.cost_factor * penalty) / scale,
            "cost_surrogate": self._unit(gain) * self._cost_surrogates(tensordict, gain.detach()),
        }
