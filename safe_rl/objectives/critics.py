"""Losses of critics, alone and with a policy loss, and the quality of their predictions."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModuleBase, dispatch
from torch import Tensor
from torchrl.objectives import LossModule

from safe_rl.objectives.advantages import VectorGAE
from safe_rl.objectives.gae import gae
from safe_rl.objectives.samples import SharesTensors, require, sample_mask
from safe_rl.objectives.surrogate import SurrogateLoss


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
    same everywhere has this error as its bias. It is NaN where all costs are unknown.

    Values and costs are those of N rows of steps, in order of time, [N, T, F]; ``done`` and
    ``terminated`` (ends that are no time-outs) are [N, T, 1] bool.
    """
    ends = done.clone()
    ends[:, -1] = True
    cut = ends & ~terminated
    sums = []
    # of a prediction of 1 and no costs, the difference is the weight of the step
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
        >>> batch = TensorDict(observation=torch.zeros(8, 3), value_target=torch.ones(8, 1))
        >>> CriticLoss(make_critic(3, hidden_sizes=[8]))(batch.auto_batch_size_(1))["loss_critic"]
        tensor(1., grad_fn=<MeanBackward0>)
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that `set_keys` accepts: outputs of the critics, and their targets."""

        value: NestedKey = "state_value"  # [..., 1]
        value_target: NestedKey = "value_target"  # [..., 1]
        cost_value: NestedKey = "cost_value"  # [..., k]
        cost_value_target: NestedKey = "cost_value_target"  # [..., k]

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
        self, critic: TensorDictModuleBase, cost_critic: TensorDictModuleBase | None = None
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
        """Evaluate the losses on a batch of any shape, which is not changed.

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
            value = require(network(tensordict.select(*network.in_keys)), value_key)
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


class ActorCriticLoss(LossModule):
    """Policy loss and critic loss in one module, for trainers with a single optimiser.

    One of them is `torchrl.trainers.algorithms.PPOTrainer`.

    Args:
        policy_loss: A `PPOLoss`, a `PPOLagrangianLoss` or another `SurrogateLoss`.
        critic_loss: Loss of the reward critic and, with constraints, of the cost critic.
        critic_coeff: Factor by which the critics' losses are multiplied.

    Examples:
        >>> from safe_rl.models import make_actor, make_critic
        >>> from safe_rl.objectives import PPOLoss
        >>> actor = make_actor(3, 2, hidden_sizes=[8], initial_log_std=-0.5)
        >>> critic = make_critic(3, hidden_sizes=[8])
        >>> policy_loss = PPOLoss(actor, clip_epsilon=0.2, entropy_coeff=0.0)
        >>> loss = ActorCriticLoss(policy_loss, CriticLoss(critic), critic_coeff=1.0)
        >>> [key for key in loss.out_keys if key.startswith("loss_")]
        ['loss_objective', 'loss_entropy', 'loss_critic']
    """

    def __init__(
        self, policy_loss: SurrogateLoss, critic_loss: CriticLoss, *, critic_coeff: float
    ) -> None:
        super().__init__()
        self.policy_loss, self.critic_loss = policy_loss, critic_loss
        self.critic_coeff = critic_coeff
        self.out_keys = [*policy_loss.out_keys, *critic_loss.out_keys]

    @property
    def actor_network(self) -> TensorDictModuleBase:
        """The policy."""
        return self.policy_loss.actor_network

    @property
    def critic_network(self) -> TensorDictModuleBase:
        """The reward critic."""
        return self.critic_loss.critic

    @property
    def in_keys(self) -> list[NestedKey]:
        """Entries of the batch that are read."""
        return list(dict.fromkeys([*self.policy_loss.in_keys, *self.critic_loss.in_keys]))

    def set_keys(self, **kwargs: NestedKey) -> None:
        """Set the keys of batch entries; each of the two losses gets the keys that it has.

        Keys of advantage estimators, which TorchRL's trainers also pass, are ignored.

        Raises:
            ValueError: If neither the losses nor the estimators have such a key.
        """
        parts: tuple[LossModule, LossModule] = (self.policy_loss, self.critic_loss)
        known = [set(part._AcceptedKeys.__dataclass_fields__) for part in parts]
        accepted = known[0] | known[1] | set(VectorGAE._AcceptedKeys.__dataclass_fields__)
        if unknown := sorted(kwargs.keys() - accepted):
            raise ValueError(f"There is no key {unknown[0]!r}, only {sorted(accepted)}.")
        for part, names in zip(parts, known, strict=True):
            part.set_keys(**{name: kwargs[name] for name in kwargs.keys() & names})

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Evaluate both losses on a batch of any shape."""
        for name in {"reduction", "_loss_mask_key"} & vars(self).keys():  # set by the user
            for part in (self.policy_loss, self.critic_loss):
                setattr(part, name, getattr(self, name))
        critic = self.critic_loss(tensordict).items()
        weighed = {
            name: self.critic_coeff * value if name.startswith("loss_") else value
            for name, value in critic
        }
        return TensorDict({**self.policy_loss(tensordict), **weighed})
