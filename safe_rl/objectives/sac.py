"""Losses of the soft actor-critic (Haarnoja et al. 2018), without and with cost limits, and CAL."""

from __future__ import annotations

from contextlib import nullcontext
from typing import Annotated, Any, Literal

import torch
from annotated_types import Interval
from pydantic import FiniteFloat, NonNegativeFloat
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase
from torch import Tensor
from torchrl import objectives
from torchrl.data import TensorSpec
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules.distributions.utils import rsample_and_log_prob
from torchrl.objectives import ValueEstimators

from safe_rl.checks import Share, Weight
from safe_rl.objectives.cost_critics import CostCritics
from safe_rl.objectives.limits import LimitState
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
        if action_spec is not None and len(action_spec.shape) > 1:  # −A would be −N A
            raise ValueError(
                f"action_spec has the shape {list(action_spec.shape)}, and must be that of one "
                "action, [A]: env.action_spec_unbatched."
            )
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
            # entering the functional call takes longer than the network
            is_own = self.cached("actor", "actor_network_params", self._has_own_actor)
            with (
                nullcontext() if is_own else self.actor_network_params.to_module(self.actor_network)
            ):
                return rsample_and_log_prob(self.actor_network.get_dist(inputs))

    def _has_own_actor(self) -> bool:
        """Whether the policy's module has the parameters of the loss, not others in their place."""
        there = {id(value) for value in self.actor_network_params.values(True, True)}
        return all(id(parameter) in there for parameter in self.actor_network.parameters())

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
    """SAC on the Lagrangian: min_π E[α log π − min Q_r + r Σ_i w_i Q_i] / (1 + Σ_i λ_i), w = λ / u.

    Ha et al., *Learning to Walk in the Real World with Minimal Human Effort* (2020). λ is not
    updated here, but from the undiscounted costs of episodes. `CostCritics` explains r and u.
    Arguments are those of `CostCritics` and of `SACLoss`.

    Examples:
        >>> from safe_rl.models import QEnsemble, make_squashed_actor
        >>> from safe_rl.objectives import LagrangeMultiplier
        >>> actor = make_squashed_actor(3, -torch.ones(2), torch.ones(2), hidden_sizes=[8])
        >>> q = QEnsemble(3, 2, hidden_sizes=[8], num_networks=2)
        >>> cost_q = QEnsemble(3, 2, hidden_sizes=[8], num_networks=1, out_key="cost_value")
        >>> costs = {"multiplier": LagrangeMultiplier(25.0, init=1, lr=0.05), "cost_keys": ["cost"]}
        >>> settings = {"gamma": 0.99, "alpha_init": 0.1, "target_entropy": -2.0}
        >>> ("next", "cost") in SACLagrangianLoss(actor, q, cost_q, **costs, **settings).in_keys
        True
    """

    def critic_losses(self, tensordict: TensorDictBase) -> TensorDict:
        """Losses of the Q functions of reward and costs, with the same next actions."""
        losses = super().critic_losses(tensordict)
        loss = self.cost_qvalue_loss(tensordict, self._next_action)
        return losses.set("loss_cost_qvalue", loss)


def discounted_share(gamma: float, episode_length: Tensor) -> Tensor:
    """Ratio of an episode's discounted to its undiscounted cost, for equal costs in all T steps.

    It is (1 − γᵀ) / ((1 − γ) T). The published code multiplies limits by this factor.
    """
    if gamma == 1:
        return torch.ones_like(episode_length)
    return (1 - gamma**episode_length) / ((1 - gamma) * episode_length)


class CALLoss(SACLagrangianLoss):
    """SAC on an augmented Lagrangian, with costs that are overestimated on purpose.

    Wu, Tang, Lin, Yu, Mao, Xie, Wang, Wang, *Off-Policy Primal-Dual Safe Reinforcement Learning*
    (ICLR 2024). The cost of an action is Q_i = mean + κ std of an ensemble (conservative policy
    optimisation). Its weight is

        λ̂_i = max(0, λ_i − c (d'_i − E[Q_i]) / u_i)                   (local policy convexification)

    the derivative of (1 / 2c) Σ_i max(0, λ_i + c (E[Q_i] − d'_i) / u_i)² by E[Q_i] / u_i. So near
    the limit the objective is convex in E[Q_i], and the policy converges to the limit instead of
    oscillating about it. The expectation is over a minibatch; u_i is explained in `CostCritics`.

    λ and the limit d are for undiscounted costs of episodes, but E[Q_i] is discounted. The article
    converts d by `discounted_share`. This has an error of some 30 %, because states in a replay
    buffer are from older policies, and costs are not spread evenly. With c = 10, this error shifts
    λ̂ by more than λ can compensate. So d' = ρ d, where ρ is measured: the critics' mean prediction
    (without κ) divided by the mean cost of an episode, both averaged over past batches.

    Args:
        networks: Actor, Q functions and cost Q functions, as in `SACLagrangianLoss`.
        convexity: Penalty coefficient c of the augmented Lagrangian, per unit of discounted cost
            above the limit.
        ratio_memory: Weight of past batches in the moving averages whose ratio is ρ.
        largest_ratio: Largest factor between ρ and `discounted_share`, up or down; 1 for the
            article's conversion.
        settings: Settings of a `SACLagrangianLoss`.

    Attributes:
        discounted_limit: d', [k]; infinite, so that λ̂ is 0, until `prepare` sets it.

    Examples:
        >>> from safe_rl.models import QEnsemble, make_squashed_actor
        >>> from safe_rl.objectives import LagrangeMultiplier
        >>> actor = make_squashed_actor(3, -torch.ones(2), torch.ones(2), hidden_sizes=[8])
        >>> q = QEnsemble(3, 2, hidden_sizes=[8], num_networks=2)
        >>> cost_q = QEnsemble(3, 2, hidden_sizes=[8], num_networks=4, out_key="cost_value")
        >>> costs = {"multiplier": LagrangeMultiplier(25.0, init=1, lr=0.05), "cost_keys": ["cost"]}
        >>> settings = {"convexity": 10.0, "ratio_memory": 0.9, "largest_ratio": 2.0}
        >>> settings |= {"gamma": 0.99, "alpha_init": 0.1, "target_entropy": -2.0}
        >>> CALLoss(actor, q, cost_q, **costs, **settings).discounted_limit
        tensor([inf])
    """

    discounted_limit: Tensor
    known_costs: Tensor
    predicted_costs: Tensor

    def __init__(
        self,
        *networks: Any,
        convexity: NonNegativeFloat,
        ratio_memory: Weight,
        largest_ratio: Annotated[float, Interval(ge=1)],
        **settings: Any,
    ) -> None:
        super().__init__(*networks, **settings)
        self.convexity = convexity
        self.ratio_memory, self.largest_ratio = ratio_memory, largest_ratio
        self.out_keys = [*self.out_keys, "cost_weight"]
        zeros = torch.zeros_like(self.cost_unit)
        self.register_buffer("discounted_limit", torch.full_like(zeros, torch.inf))
        # averages over batches: of predicted costs, and of J_c
        self.register_buffer("known_costs", torch.zeros(2, *zeros.shape, device=zeros.device))
        # sum and number of the predictions since the last `prepare`
        self.register_buffer("predicted_costs", torch.zeros(2, *zeros.shape, device=zeros.device))

    def cost_weights(self, values: Tensor) -> Tensor:
        """λ̂ / u, [k]; also adds the critics' mean predictions to the sums for `prepare`."""
        # here, because the values are computed for each update of the policy anyway
        means = self.cost_values.mean(values).flatten(0, -2).mean(0).to(self.predicted_costs)
        self.predicted_costs.add_(torch.stack([means, torch.ones_like(means)]))
        expected = self.cost_of(values).reshape(-1, values.shape[-1]).mean(0)
        excess = (expected - self.discounted_limit) / self.cost_unit
        weight = self.multiplier.value.to(excess) + self.convexity * excess
        return weight.clamp_min(0) / self.cost_unit

    def prepare(self, batch: TensorDictBase, limits: LimitState) -> None:
        """Also compute d' from the predictions since the last call, J_c and its target."""
        super().prepare(batch, limits)
        total, number = self.predicted_costs
        expected = discounted_share(self.gamma, limits.length_for(limits.cost))
        if number.any():
            news = torch.stack([total / number, limits.cost])
            averages = self.known_costs.lerp(news, 1 - self.ratio_memory)
            # J_c is NaN as long as no episode says what it is
            self.known_costs.copy_(averages.where(limits.cost.isfinite(), self.known_costs))
            self.predicted_costs.zero_()
        by_critics, by_episodes = self.known_costs
        ratio = torch.where(by_episodes > 0, by_critics / by_episodes, expected)
        ratio = ratio.clamp(expected / self.largest_ratio, expected * self.largest_ratio)
        self.discounted_limit.copy_(ratio * limits.target)
