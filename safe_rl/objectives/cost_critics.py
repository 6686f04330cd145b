"""Critics of k costs, for off-policy losses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import torch
from pydantic import FiniteFloat
from tensordict import NestedKey, TensorDictBase, TensorDictParams, unravel_key
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from safe_rl.objectives.cost_values import CostValues, MeanCosts
from safe_rl.objectives.critics import critic_bias
from safe_rl.objectives.limits import LimitState, check_order
from safe_rl.objectives.multipliers import Multiplier
from safe_rl.objectives.q_functions import QFunctionLoss, check_ensemble, discount_of
from safe_rl.objectives.samples import sample_mask


class CostCritics(QFunctionLoss):
    """Mixin that adds k cost critics to an off-policy loss: their TD(0) loss, the actor's penalty.

    A policy that minimises Q_c exploits actions whose cost is underestimated, and bootstrapping
    spreads such errors. Against this, TD targets use mean_E Q' + κ' std_E Q' over an ensemble of E
    networks. For E = 2 and κ' = 1, this is the larger of the two values. The actor's loss gets the
    penalty r Σ_i λ_i (mean_E Q_i + κ std_E Q_i) / u_i, where u_i is the typical size of one cost
    and r the standard deviation of rewards. So with λ = 1, one cost weighs as much as a reward of
    size r. Loss and penalty are divided by 1 + Σ λ_i: the step size does not grow with λ.

    In a class definition it comes before the loss without costs. The critic loss has to call
    `cost_qvalue_loss`, and the actor loss `penalised`.

    Args:
        actor_network, qvalue_network: Networks of the loss without costs.
        cost_qvalue_network: A `safe_rl.models.QEnsemble` of E critics, whose outputs are what
            `cost_values` says; by default one per cost.
        multiplier: λ; read at every call. It is not part of the loss or its ``state_dict``.
        cost_keys: Keys of the costs below ``next``, [..., 1] each. Transitions over n steps need
            discounted sums of costs, and the end of their last step: `MultiStepTransform` with the
            costs in ``reward_keys``, and ``done_keys=[]``.
        cost_values: What the outputs of a critic mean; by default `MeanCosts`.
        pessimism: Number κ of standard deviations among the cost critics that is added to their
            mean in the actor's loss.
        target_pessimism: κ', the same in TD targets; None: every critic bootstraps on its own
            target network.
        lowest_cost_value: Lower bound of the values that critics bootstrap on, such as 0 if no cost
            is negative; None: no bound.
        settings: Settings of the loss without costs.

    Raises:
        ValueError: If the cost critic is no ensemble, or there is not one multiplier per cost. By
            the actor's loss, if `prepare` has not been called: u and r are not known.

    Attributes:
        cost_unit: u, the typical size of one cost (`LimitState.unit`), [k].
        reward_unit: r, the standard deviation of the rewards of all steps; 1 while they are equal.
    """

    out_keys: list[str]
    cost_qvalue_network: TensorDictModuleBase
    cost_qvalue_network_params: TensorDictParams
    target_cost_qvalue_network_params: TensorDictParams
    cost_unit: Tensor
    reward_unit: Tensor
    reward_sums: Tensor
    _is_prepared = False

    def __init__(
        self,
        actor_network: TensorDictModuleBase,
        qvalue_network: TensorDictModuleBase,
        cost_qvalue_network: TensorDictModuleBase,
        *,
        multiplier: Multiplier,
        cost_keys: Sequence[NestedKey],
        cost_values: CostValues | None = None,
        pessimism: FiniteFloat = 0.0,
        target_pessimism: FiniteFloat | None = None,
        lowest_cost_value: FiniteFloat | None = None,
        **settings: Any,
    ) -> None:
        device = next(cost_qvalue_network.parameters()).device
        check_ensemble(cost_qvalue_network, "cost critic")
        self.cost_values = MeanCosts() if cost_values is None else cost_values
        # the base's constructor makes in_keys of these
        self.cost_keys, self._read = list(cost_keys), list(cost_qvalue_network.in_keys[:-1])
        if multiplier.num_costs != len(self.cost_keys):
            raise ValueError(f"{multiplier.num_costs} multipliers for the costs {self.cost_keys}.")
        check_order(self.cost_keys, multiplier.cost_keys)
        super().__init__(actor_network, qvalue_network, **settings)
        self.convert_to_functional(
            cost_qvalue_network, "cost_qvalue_network", create_target_params=True
        )
        self.out_keys = [
            *self.out_keys, "loss_cost_qvalue", "cost_qvalue", *self.cost_values.columns
        ]  # fmt: skip
        self.pessimism, self.target_pessimism = pessimism, target_pessimism
        self.lowest_cost_value = lowest_cost_value
        # not a part of the loss: its owner saves it
        self.__dict__["multiplier"] = multiplier
        self.register_buffer("cost_unit", torch.ones(len(cost_keys), device=device))
        self.register_buffer("reward_unit", torch.ones((), device=device))
        # number, sum and sum of squares of the rewards so far
        self.register_buffer("reward_sums", torch.zeros(3, dtype=torch.float64, device=device))

    def _set_in_keys(self) -> None:
        super()._set_in_keys()
        following = (unravel_key(("next", key)) for key in (*self._read, *self.cost_keys))
        self._in_keys = list(dict.fromkeys([*self._in_keys, *self._read, *following]))

    def values_of_costs(
        self,
        steps: TensorDictBase,
        action: Tensor,
        kind: Literal["own", "target", "frozen"] = "own",
    ) -> Tensor:
        """Numbers of the E critics for actions, [n, E, ..., k]; see `q_values`."""
        outputs = self.q_values("cost_qvalue_network", steps, action, kind)
        return self.cost_values.arranged(outputs, len(self.cost_keys))

    @torch.no_grad()
    def cost_bias(self, batch: TensorDictBase) -> Tensor:
        """Bias of the critics on steps [N, T] of the current policy, [k]; see `critic_bias`."""
        keys = self.tensor_keys
        steps = batch.select(*self.in_keys, ("next", keys.done), strict=False)
        steps = steps.to(self.cost_unit.device)
        values = self.values_of_costs(steps, steps.get(keys.action))
        costs = torch.cat([self.column(steps, key) for key in self.cost_keys], -1)
        ends = self.column(steps, keys.done), self.column(steps, keys.terminated)
        return critic_bias(self.cost_values.mean(values).mean(0), costs, *ends, self.gamma)

    def prepare(self, batch: TensorDictBase, limits: LimitState) -> None:
        """Update the size u of one cost, and the deviation r of rewards with those of new steps."""
        limits.check(self.cost_keys)
        self.cost_unit.copy_(limits.unit)
        mask = sample_mask(batch, self)
        rewards = batch.get(("next", self.tensor_keys.reward)).detach()
        rewards = (rewards if mask is None else rewards[mask]).flatten().to(self.reward_sums)
        powers = torch.stack([torch.ones_like(rewards), rewards, rewards.square()])
        self.reward_sums.add_(powers.sum(-1))
        number, total, squares = self.reward_sums
        variance = squares / number - (total / number).square()
        varies = variance > 1e-12 * squares / number  # more than by rounding errors
        self.reward_unit.copy_(torch.where(varies, variance.sqrt(), 1.0))
        self._is_prepared = True

    def cost_qvalue_loss(self, tensordict: TensorDictBase, next_action: Tensor) -> Tensor:
        """Loss of the cost critics, summed over networks and costs."""
        following = tensordict.get("next")
        costs = torch.cat([self.column(tensordict, key) for key in self.cost_keys], -1)
        with torch.no_grad():
            values = self.values_of_costs(following, next_action, "target")
            terminated = self.column(tensordict, self.tensor_keys.terminated)
            spanned = self.value_estimator.tensor_keys.steps_to_next_obs
            discount = discount_of(tensordict, self.gamma, spanned) * terminated.logical_not()
        predicted = self.values_of_costs(tensordict, tensordict.get(self.tensor_keys.action))
        errors = self.cost_values.errors(predicted, costs, discount, values, self.bounded)
        return self._mean(errors.sum(-1).sum(0), tensordict)

    def bounded(self, values: Tensor) -> Tensor:
        """Costs to bootstrap on, from those of the E target networks, [E, ...]."""
        if self.target_pessimism is not None:
            values = pessimistic(values, self.target_pessimism).expand_as(values)
        lowest = self.lowest_cost_value
        return values if lowest is None else values.clamp_min(lowest)

    def penalised(
        self, objective: Tensor, tensordict: TensorDictBase, action: Tensor
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """The actor's loss [...] with the cost penalty, and diagnostics."""
        if not self._is_prepared and not self.reward_sums[0]:  # nor restored from a state
            raise ValueError(
                f"{type(self).__name__} does not know the scales of costs and rewards: call "
                "prepare(batch, limits) with every batch, before its updates."
            )
        values = self.values_of_costs(tensordict, action, "frozen")
        samples = self.of_samples(values.detach(), tensordict, first=2)
        weights = self.cost_weights(samples).to(values)
        penalty = self.reward_unit * (self.cost_of(values) @ weights)
        # by λ, which has no unit: the size of the loss then does not depend on that of the costs
        objective = (objective + penalty) / (1 + (weights * self.cost_unit).sum())
        figures = {"cost_qvalue": self.cost_values.mean(samples)}
        figures |= self.cost_values.figures(samples)
        reported = {name: each.flatten(0, -2).mean(0) for name, each in figures.items()}
        reported["cost_weight"] = weights
        return objective, {name: x for name, x in reported.items() if name in self.out_keys}

    def cost_of(self, values: Tensor) -> Tensor:
        """Costs of actions as the actor's loss has them, [..., k], from [n, E, ..., k]."""
        return pessimistic(self.cost_values.cost(values), self.pessimism)

    def cost_weights(self, values: Tensor) -> Tensor:
        """Weights of the costs in the actor's loss, [k]: λ / u."""
        return self.multiplier.value.to(self.cost_unit) / self.cost_unit


def pessimistic(values: Tensor, deviations: float) -> Tensor:
    """Mean of an ensemble [E, ...] plus a number of its standard deviations, [...]."""
    mean = values.mean(0)
    return mean + deviations * values.std(0, correction=0) if deviations else mean
