"""Losses of the soft actor-critic (Haarnoja et al. 2018), without and with cost limits."""

from __future__ import annotations

from typing import Annotated, Literal

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase
from torch import Tensor
from torchrl import objectives
from torchrl.data import TensorSpec
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules.distributions.utils import rsample_and_log_prob
from torchrl.objectives import ValueEstimators
from torchrl.objectives.utils import distance_loss
from torchrl.objectives.value import TD0Estimator

from safe_rl.objectives.cost_critics import CostCritics
from safe_rl.objectives.q_functions import (
    Distance,
    InOneCall,
    QFunctionLoss,
    check_ensemble,
    discount_of,
)
from safe_rl.objectives.samples import require
from safe_rl.ranges import Number, Range, Share


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
        loss_function: Loss of the TD errors.
        action_spec: Spec of one action [A]; needed for ``target_entropy="auto"``.

    Examples:
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
        alpha_init: Annotated[float, Range(1e-9, 1e9)],
        target_entropy: Number | Literal["auto"] = "auto",
        fixed_alpha: bool = False,
        loss_function: Distance = "l2",
        action_spec: TensorSpec | None = None,
    ) -> None:
        check_ensemble(qvalue_network, "Q function of rewards")
        super().__init__(
            actor_network,
            qvalue_network,
            num_qvalue_nets=0,
            loss_function=loss_function,
            alpha_init=alpha_init,
            target_entropy=target_entropy,
            fixed_alpha=fixed_alpha,
            action_spec=action_spec,
        )
        self.gamma = gamma
        self.make_value_estimator(ValueEstimators.TD0, gamma=gamma)
        self.out_keys = ["loss_qvalue", "loss_actor", "loss_alpha", "alpha", "entropy"]

    def _make_vmap(self) -> None:
        self._vmap_qnetworkN0 = InOneCall(self.qvalue_network)

    def _compute_target_v2(self, tensordict: TensorDictBase) -> Tensor:
        """TorchRL's TD targets [...]; TD(0), the default, is computed in half of TorchRL's time."""
        keys, following = self.tensor_keys, tensordict.get("next")
        with torch.no_grad():
            self._next_action, log_prob = self._act(following)
            values = self.q_values("qvalue_network", following, self._next_action, "target")
            lowest = values.min(0).values
            soft = lowest - self._alpha * log_prob.unsqueeze(-1)
            estimator = self.value_estimator
            if type(estimator) is not TD0Estimator or estimator.average_rewards:
                steps = tensordict.clone(False).set(("next", estimator.tensor_keys.value), soft)
                return estimator.value_estimate(steps).squeeze(-1)
            goes_on = self.column(tensordict, keys.terminated).logical_not()
            spanned = estimator.tensor_keys.steps_to_next_obs
            discount = discount_of(tensordict, self.gamma, spanned)
            reward = self.column(tensordict, keys.reward)
            return (reward + discount * goes_on * soft).squeeze(-1)

    def _act(self, steps: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Actions of the current policy, with gradients, and log π."""
        with set_exploration_type(ExplorationType.RANDOM):
            # a copy, because the policy writes its distribution's parameters into its input
            inputs = steps.select(*self.actor_network.in_keys)
            return rsample_and_log_prob(self.actor_network.get_dist(inputs))

    def critic_losses(self, tensordict: TensorDictBase) -> TensorDict:
        """Losses of the Q functions."""
        keys = self.tensor_keys
        target = self._compute_target_v2(tensordict)
        action = require(tensordict, keys.action)
        values = self.q_values("qvalue_network", tensordict, action).squeeze(-1)
        errors = distance_loss(values, target.expand_as(values), loss_function=self.loss_function)
        tensordict.set(keys.priority, (values.detach() - target).abs().max(0).values)
        return TensorDict(loss_qvalue=self._mean(errors.sum(0), tensordict))

    def actor_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Loss of the policy, with the penalty on costs if there are cost critics."""
        action, log_prob = self._act(tensordict)
        values = self.q_values("qvalue_network", tensordict, action, "frozen")
        objective = self._alpha * log_prob - values.min(0).values.squeeze(-1)
        objective, reported = self.penalised(objective, tensordict, action)
        return self._mean(objective, tensordict), {"log_prob": log_prob.detach(), **reported}

    def actor_losses(self, tensordict: TensorDictBase) -> TensorDict:
        """Losses of the policy and of α, and diagnostics."""
        loss, metadata = self.actor_loss(tensordict)
        log_prob = metadata.pop("log_prob")
        alpha = self._mean(self.alpha_loss(log_prob), tensordict)
        entropy = -self._reduce_loss(log_prob, tensordict, reduction="mean")
        metadata |= {"alpha": self._alpha, "entropy": entropy}
        return TensorDict(loss_actor=loss, loss_alpha=alpha, **metadata)


class SACLagrangianLoss(CostCritics, SACLoss):
    """SAC on the Lagrangian: min_π E[α log π − min Q_r + r Σ_i w_i Q_i] / (1 + Σ_i w_i), w = λ / u.

    Ha et al., *Learning to Walk in the Real World with Minimal Human Effort* (2020). λ is not
    updated here, but from the undiscounted costs of episodes. `CostCritics` explains r and u.
    Arguments are those of `CostCritics` and of `SACLoss`.

    Examples:
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
