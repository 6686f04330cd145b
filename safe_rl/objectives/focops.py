"""First-order constrained optimisation in policy space (Zhang, Vuong and Ross 2020)."""

from __future__ import annotations

from typing import Annotated

from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential
from torch import Tensor

from safe_rl.objectives.multipliers import Multiplier
from safe_rl.objectives.surrogate import Reduction, SurrogateLoss, require_multiplier
from safe_rl.ranges import NotNegative, Positive, Range


class FOCOPSLoss(SurrogateLoss):
    """Distance to the optimal policy of the trust region, projected on the networks'.

    Minimises (Zhang, Vuong and Ross 2020, the gradient of its projection)

        E[1{KL(s) ≤ δ} (KL(s) − (1/β) ρ (A − Σᵢ νᵢ A_cᵢ))],  KL(s) = KL(π_θ ‖ π_k) in state s.

    Its minimum over all policies is π_k exp((A − Σᵢ νᵢ A_cᵢ)/β) / Z, the optimum within the
    trust region of which β and ν are the multipliers. States that have gone further
    than δ teach nothing. Adds ``trusted_fraction``, the share of the others.

    Args:
        actor_network: policy with `get_dist`; see `SurrogateLoss`.
        multiplier: one ν per column of ``cost_advantage``; a `ProjectedMultiplier` in the article.
        temperature: Multiplier β of the trust region, named λ in the article.
        max_state_kl: KL divergence δ beyond which a state is ignored.
        entropy_coeff: Factor of the entropy bonus.
        reduction: How samples are reduced; ``"none"`` keeps them, which no update takes.

    Raises:
        TypeError: if there is no multiplier.

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
        actor_network: ProbabilisticTensorDictSequential,
        multiplier: Multiplier,
        *,
        temperature: Annotated[float, Range(1e-9, 1e9)],
        max_state_kl: Positive,
        entropy_coeff: NotNegative,
        reduction: Reduction = "mean",
    ) -> None:
        super().__init__(
            actor_network,
            entropy_coeff=entropy_coeff,
            reduction=reduction,
            multiplier=require_multiplier(multiplier, "PPOLoss"),
        )
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
