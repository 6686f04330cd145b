"""Losses of the reward critic and the cost critic, and the quality of their predictions."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModuleBase, dispatch
from torch import Tensor

from safe_rl.objectives.gae import gae
from safe_rl.objectives.samples import SharesTensors, require, sample_mask


def explained_variance(prediction: Tensor, target: Tensor) -> Tensor:
    """1 − Var(target − prediction) / Var(target), per column: [..., F] -> [F].

    1 is perfect, 0 no better than a constant. It is also 0 for a constant target.
    """
    residual = (target - prediction).flatten(0, -2).var(0, correction=0)
    total = target.flatten(0, -2).var(0, correction=0)
    return (1 - residual / total).where(total > 0, 0.0)


def critic_bias(
    value: Tensor, cost: Tensor, done: Tensor, terminated: Tensor, gamma: float
) -> Tensor:
    """Mean of a critic's predictions minus the discounted sums of later costs, [F].

    Costs are summed to the end of the episode. If the end of a row or a time-out cuts an episode,
    later costs are unknown. Then the critic's prediction at the last step replaces them, and a step
    n steps before the cut has only the weight 1 − γⁿ in the mean. So a critic whose error is the
    same everywhere has this error as its bias.

    Args:
        value: Predictions for the steps of N rows, in order of time, [N, T, F].
        cost: Costs of these steps, [N, T, F].
        done: Whether an episode ends with a step, [N, T, 1] bool.
        terminated: Whether it ends there by termination, not by a time-out, [N, T, 1] bool.
        gamma: Discount γ per step.

    Returns:
        The bias, NaN where all costs are unknown.

    Examples:
        >>> value, cost = torch.full((1, 3, 1), 5.0), torch.ones(1, 3, 1)
        >>> ends = torch.tensor([[[False], [False], [True]]])
        >>> critic_bias(value, cost, ends, ends, gamma=1.0)  # 5 - 3, 5 - 2 and 5 - 1
        tensor([3.])
    """
    ends = done.clone()
    ends[:, -1] = True
    cut = ends & ~terminated
    sums = []
    for signal, prediction in ((cost, value), (torch.zeros_like(value), torch.ones_like(value))):
        # at a cut, later costs are taken to agree with the prediction
        signal = torch.where(cut, prediction, signal)
        following = torch.where(cut, 0.0, prediction.roll(-1, 1))
        sums.append(-gae(signal, prediction, following, ends, terminated, gamma=gamma, lmbda=1.0))
    difference, weight = (total.flatten(0, 1).sum(0) for total in sums)
    return difference / torch.where(weight > 0, weight, torch.nan)


class CriticLoss(SharesTensors):
    """Squared errors of a reward critic and, if there is one, of a cost critic.

    Returns ``loss_critic`` and ``loss_cost_critic`` (summed over the k costs), whose sum is to be
    minimised, and the detached ``explained_variance`` (scalar) and ``cost_explained_variance`` [k].

    Args:
        critic: Reward critic, which writes the value key, [..., 1].
        cost_critic: Cost critic, which writes the cost value key, [..., k]; or None.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from safe_rl.models import make_critic
        >>> critic = make_critic(3, hidden_sizes=[8])
        >>> cost_critic = make_critic(3, hidden_sizes=[8], num_outputs=2, out_key="cost_value")
        >>> batch = TensorDict(
        ...     observation=torch.randn(8, 3),
        ...     value_target=torch.randn(8, 1),
        ...     cost_value_target=torch.randn(8, 2),
        ...     batch_size=[8],
        ... )
        >>> losses = CriticLoss(critic, cost_critic)(batch)
        >>> (losses["loss_critic"] + losses["loss_cost_critic"]).backward()
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that `set_keys` accepts.

        Attributes:
            value: The critic's output, [..., 1].
            value_target: Its target, [..., 1].
            cost_value: The cost critic's output, [..., k].
            cost_value_target: Its target, [..., k].
        """

        value: NestedKey = "state_value"
        value_target: NestedKey = "value_target"
        cost_value: NestedKey = "cost_value"
        cost_value_target: NestedKey = "cost_value_target"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys

    reduction = "mean"
    critic: TensorDictModuleBase
    critic_params: TensorDictParams
    target_critic_params: TensorDictParams
    cost_critic: TensorDictModuleBase | None
    cost_critic_params: TensorDictParams | None
    target_cost_critic_params: TensorDictParams | None

    def __init__(
        self,
        critic: TensorDictModuleBase,
        cost_critic: TensorDictModuleBase | None = None,
    ) -> None:
        super().__init__()
        self.convert_to_functional(critic, "critic")
        self.out_keys = ["loss_critic", "explained_variance"]
        self.cost_critic, self.cost_critic_params = None, None
        if cost_critic is not None:
            self.convert_to_functional(cost_critic, "cost_critic")
            self.out_keys = [*self.out_keys, "loss_cost_critic", "cost_explained_variance"]

    @property
    def in_keys(self) -> list[NestedKey]:
        """Entries of the batch that are read."""
        keys = [*self.critic.in_keys, self.tensor_keys.value_target]
        if self.cost_critic is not None:
            keys += [*self.cost_critic.in_keys, self.tensor_keys.cost_value_target]
        return list(dict.fromkeys(keys))

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Evaluate the losses.

        Args:
            tensordict: Batch of any shape with `in_keys`; left as it is.

        Returns:
            TensorDict with `out_keys`, without batch dimension.

        Raises:
            KeyError: If an entry is missing.
            ValueError: If a value and its target differ in shape.
        """
        keys = self.tensor_keys
        loss, variance = self._regression(tensordict, "critic", keys.value, keys.value_target)
        out = {"loss_critic": loss, "explained_variance": variance.squeeze(-1)}
        if self.cost_critic is not None:
            out["loss_cost_critic"], out["cost_explained_variance"] = self._regression(
                tensordict, "cost_critic", keys.cost_value, keys.cost_value_target
            )
        losses = TensorDict(out)
        self._clear_weakrefs(tensordict, losses, "critic_params", "cost_critic_params")
        return losses

    def _regression(
        self, tensordict: TensorDictBase, name: str, value_key: NestedKey, target_key: NestedKey
    ) -> tuple[Tensor, Tensor]:
        """Squared error, summed over columns, and explained variance [F] of one critic."""
        network, params = getattr(self, name), getattr(self, f"{name}_params")
        target = require(tensordict, target_key, "VectorGAE and CostGAE write value targets.")
        with params.to_module(network, preserve_module_state=False):
            value = network(tensordict.select(*network.in_keys)).get(value_key)
        if value.shape != target.shape:
            raise ValueError(
                f"{value_key!r} has shape {tuple(value.shape)} but {target_key!r} has "
                f"{tuple(target.shape)}: the {name} needs one output per target."
            )
        error = (value - target).square().sum(-1)
        mask = sample_mask(tensordict, self)
        predicted, wanted = value.detach(), target
        if mask is not None:
            predicted, wanted = predicted[mask], wanted[mask]
        return self._reduce_loss(error, tensordict), explained_variance(predicted, wanted)
