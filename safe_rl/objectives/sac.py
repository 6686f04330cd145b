"""Losses of the soft actor-critic (Haarnoja et al. 2018), without and with cost limits."""

from __future__ import annotations

from typing import Annotated, Literal

from annotated_types import Interval
from pydantic import FiniteFloat
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase
from torch import Tensor
from torchrl import objectives
from torchrl.data import TensorSpec
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules.distributions.utils import rsample_and_log_prob
from torchrl.objectives import ValueEstimators

from safe_rl.checks import Share
from safe_rl.objectives.cost_critics import CostCritics
from safe_rl.objectives.q_functions import QFunctionLoss, check_ensemble


class SACLoss(QFunctionLoss, objectives.SACLoss):
    """TorchRL's SAC loss, split into critic and actor losses, with ensembles that need no vmap.

    Args:
        actor_network: Policy with ``get_dist``.
        qvalue_network: A `safe_rl.models.QEnsemble`.
        gamma: Discount per step, of reward and costs.
        alpha_init: Initial entropy coefficient (temperature) α.
        target_entropy: Entropy of the policy that α is adapted to reach; ``"auto"`` is −A for
            actions [A].
        fixed_alpha: Whether the entropy coefficient α is constant.
        action_spec: Spec of one action [A]; needed for ``target_entropy="auto"``.

    Examples:
        >>> import torch
        >>> from safe_rl.models import QEnsemble, make_squashed_actor
        >>> actor = make_squashed_actor(3, -torch.ones(2), torch.ones(2), hidden_sizes=[8])
        >>> q = QEnsemble(3, 2, hidden_sizes=[8], num_networks=2)
        >>> SACLoss(actor, q, gamma=0.99, alpha_init=0.1, target_entropy=-2.0).out_keys
        ['loss_qvalue', 'loss_actor', 'loss_alpha', 'alpha', 'entropy']
    """

    _next_action: Tensor

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModuleBase,
        *,
        gamma: Share,
        alpha_init: Annotated[float, Interval(ge=1e-9, le=1e9)],
        target_entropy: FiniteFloat | Literal["auto"] = "auto",
        fixed_alpha: bool = False,
        action_spec: TensorSpec | None = None,
    ) -> None:
        check_ensemble(qvalue_network, "Q function of rewards")
        super().__init__(
            actor_network,
            qvalue_network,
            num_qvalue_nets=0,
            loss_function="l2",
            alpha_init=alpha_init,
            target_entropy=target_entropy,
            fixed_alpha=fixed_alpha,
            action_spec=action_spec,
        )
        self.gamma = gamma
        self.make_value_estimator(ValueEstimators.TD0, gamma=gamma)
        self.out_keys = ["loss_qvalue", "loss_actor", "loss_alpha", "alpha", "entropy"]

    def _next_values(self, following: TensorDictBase) -> Tensor:
        """Values of the next states, with their entropy."""
        self._next_action, log_prob = self._act(following)
        values = self.q_values("qvalue_network", following, self._next_action, "target")
        return values.min(0).values - self._alpha * log_prob.unsqueeze(-1)

    def _act(self, steps: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Actions of the current policy, with gradients, and log π."""
        with set_exploration_type(ExplorationType.RANDOM):
            # a copy, because the policy writes its distribution's parameters into its input
            inputs = steps.select(*self.actor_network.in_keys)
            return rsample_and_log_prob(self.actor_network.get_dist(inputs))

    def actor_losses(self, tensordict: TensorDictBase) -> TensorDict:
        """Losses of the policy and of α, and diagnostics."""
        action, log_prob = self._act(tensordict)
        values = self.q_values("qvalue_network", tensordict, action, "frozen")
        objective = self._alpha * log_prob - values.min(0).values.squeeze(-1)
        objective, reported = self.penalised(objective, tensordict, action)
        log_prob = log_prob.detach()
        return TensorDict(
            loss_actor=self._mean(objective, tensordict),
            loss_alpha=self._mean(self.alpha_loss(log_prob), tensordict),
            alpha=self._alpha,
            entropy=-self._reduce_loss(log_prob, tensordict, reduction="mean"),
            **reported,
        )


class SACLagrangianLoss(CostCritics, SACLoss):
    """SAC on the Lagrangian: min_π E[α log π − min Q_r + r Σ_i w_i Q_i] / (1 + Σ_i w_i), w = λ / u.

    Ha et al., *Learning to Walk in the Real World with Minimal Human Effort* (2020). λ is not
    updated here, but from the undiscounted costs of episodes. `CostCritics` explains r and u.
    Arguments are those of `CostCritics` and of `SACLoss`.

    Examples:
        >>> import torch
        >>> from safe_rl.models import QEnsemble, make_squashed_actor
        >>> from safe_rl.objectives import LagrangeMultiplier
        >>> actor = make_squashed_actor(3, -torch.ones(2), torch.ones(2), hidden_sizes=[8])
        >>> q = QEnsemble(3, 2, hidden_sizes=[8], num_networks=2)
        >>> cost_q = QEnsemble(3, 2, hidden_sizes=[8], num_networks=1, out_key="cost_value")
        >>> multiplier = LagrangeMultiplier({"cost": 25.0}, init=1.0, lr=0.05)
        >>> settings = {"gamma": 0.99, "alpha_init": 0.1, "target_entropy": -2.0}
        >>> loss = SACLagrangianLoss(
        ...     actor, q, cost_q, multiplier=multiplier, cost_keys=["cost"], **settings
        ... )
        >>> ("next", "cost") in loss.in_keys, "loss_cost_qvalue" in loss.out_keys
        (True, True)
    """

    def critic_losses(self, tensordict: TensorDictBase) -> TensorDict:
        """Losses of the Q functions of reward and costs, with the same next actions."""
        losses = super().critic_losses(tensordict)
        loss = self.cost_qvalue_loss(tensordict, self._next_action)
        return losses.set("loss_cost_qvalue", loss)
