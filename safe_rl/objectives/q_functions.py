"""What losses on Q functions share: ensembles without vmap, and critics of k costs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NotRequired, TypedDict

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.objectives import LossModule
from torchrl.objectives.utils import distance_loss
from torchrl.objectives.value.functional import td0_return_estimate

from safe_rl.objectives.keys import require
from safe_rl.objectives.multipliers import Multiplier

__all__ = ["CostCritics", "CostTerms", "is_ensemble", "scalars"]


class CostTerms(TypedDict):
    """Keyword arguments of every loss with cost critics.

    Attributes:
        multiplier: λ; read at every call.
        cost_keys: costs below ``next``, [..., 1] each.
        pessimism: κ, standard deviations among the cost critics that are added to their mean.
    """

    multiplier: Multiplier
    cost_keys: Sequence[NestedKey]
    pessimism: NotRequired[float]


def is_ensemble(network: Any) -> bool:
    """Whether a network evaluates several Q functions by itself, such as a `QEnsemble`.

    It has ``num_networks``, and takes steps [...] and parameters to values [E, ...].
    """
    return hasattr(network, "num_networks")


class CostCritics(LossModule):
    """k cost critics for a loss on Q functions: their TD(0) loss, and the penalty on the actor.

    Every network of the ensemble Q_c bootstraps on its own target network. The penalty on an
    action is Σ_i λ_i (mean_E Q_i + κ std_E Q_i) / u_i, with the multipliers λ, the pessimism κ and
    the size u of one cost; the sum of the actor's objective and this is divided by 1 + Σ λ_i / u_i,
    so that the step size does not grow with λ.

    Classes that inherit from it call `_add_cost_critics` in their constructor.

    Attributes:
        cost_unit: u, the size of one cost, [k]; a buffer of ones unless somebody sets it.
    """

    cost_qvalue_network: TensorDictModuleBase
    cost_qvalue_network_params: TensorDictParams
    target_cost_qvalue_network_params: TensorDictParams
    cost_unit: Tensor
    gamma: float
    loss_function: str

    def _add_cost_critics(
        self,
        network: TensorDictModuleBase,
        multiplier: Multiplier,
        cost_keys: Sequence[NestedKey],
        pessimism: float,
    ) -> None:
        if not is_ensemble(network):
            raise ValueError(
                "The cost critic has to be a safe_rl.models.QEnsemble with one output per cost, "
                f"not a {type(network).__name__}."
            )
        if len(cost_keys) != multiplier.num_costs:
            raise ValueError(
                f"There are {len(cost_keys)} cost_keys but {multiplier.num_costs} multipliers."
            )
        self.convert_to_functional(network, "cost_qvalue_network", create_target_params=True)
        self.cost_keys, self.pessimism = list(cost_keys), pessimism
        # not a part of the loss: whoever moves it saves it
        self.__dict__["multiplier"] = multiplier
        device = next(network.parameters()).device
        self.register_buffer("cost_unit", torch.ones(len(cost_keys), device=device))

    def cost_values(self, steps: TensorDictBase, action: Tensor, params: TensorDictBase) -> Tensor:
        """Q_c of actions in the states of steps [...], by every network: [E, ..., k]."""
        network = self.cost_qvalue_network
        inputs = steps.select(*network.in_keys, strict=False)
        inputs.set(self.tensor_keys.action, action)
        return network(inputs, params).get(network.out_keys[0])

    def cost_qvalue_loss(self, tensordict: TensorDictBase, next_action: Tensor) -> Tensor:
        """Loss of the cost critics, summed over networks and costs."""
        following = tensordict.get("next")
        costs = torch.cat([require(tensordict, ("next", key)) for key in self.cost_keys], -1)
        with torch.no_grad():
            values = self.cost_values(
                following, next_action, self.target_cost_qvalue_network_params
            )
            terminated = following.get(self.tensor_keys.terminated)
            target = td0_return_estimate(
                gamma=self._discount(tensordict),
                next_state_value=values,
                reward=costs.expand_as(values),
                terminated=terminated.expand_as(values),
            )
        found = self.cost_values(
            tensordict, tensordict.get(self.tensor_keys.action), self.cost_qvalue_network_params
        )
        loss = distance_loss(found, target, loss_function=self.loss_function).sum(-1).sum(0)
        weights = self._maybe_get_priority_weight(tensordict)
        return self._reduce_loss(loss, tensordict=tensordict, weights=weights)

    @property
    def _detached_cost_params(self) -> TensorDictBase:
        # TorchRL forgets what begins so whenever parameters move to another device or dtype
        if "_cached_cost_params" not in self.__dict__:
            self.__dict__["_cached_cost_params"] = self.cost_qvalue_network_params.data
        return self.__dict__["_cached_cost_params"]

    def _discount(self, tensordict: TensorDictBase) -> Tensor:
        """γ to the power of the steps that a transition spans, [..., 1]."""
        steps = tensordict.get("steps_to_next_obs", None)
        gamma = self.cost_unit.new_full((1,), self.gamma)
        return gamma if steps is None else gamma ** steps.unsqueeze(-1)

    def penalised(
        self, objective: Tensor, tensordict: TensorDictBase, action: Tensor
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """The actor's objective [...] with the costs of its actions.

        Returns:
            The objective, and ``cost_qvalue`` and ``cost_weight``: the mean of Q_c and what it was
            multiplied by, [k].
        """
        values = self.cost_values(tensordict, action, self._detached_cost_params)
        pessimistic = values.mean(0)
        if self.pessimism:
            pessimistic = pessimistic + self.pessimism * values.std(0, correction=0)
        weights = self.cost_weights(pessimistic.detach()).to(values)
        objective = (objective + pessimistic @ weights) / (1 + weights.sum())
        mean = values.detach().flatten(0, -2).mean(0)
        return objective, {"cost_qvalue": mean, "cost_weight": weights}

    def cost_weights(self, values: Tensor) -> Tensor:
        """What the actor's Q_c, which is [..., k], is multiplied by, [k]: λ / u."""
        return self.multiplier.value / self.cost_unit


def scalars(**entries: Tensor) -> TensorDict:
    """Losses and diagnostics without batch dimension."""
    return TensorDict(entries, batch_size=[])
