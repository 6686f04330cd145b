"""Losses of deterministic policies: TD3, with and without costs, and behaviour cloning."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from pydantic import NonNegativeFloat
from tensordict import NestedKey, TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModuleBase, dispatch
from torch import Tensor
from torch.nn.functional import mse_loss
from torchrl import objectives
from torchrl.data import TensorSpec
from torchrl.objectives import ValueEstimators

from safe_rl.checks import Share
from safe_rl.objectives.cost_critics import CostCritics
from safe_rl.objectives.q_functions import QFunctionLoss, ReplayLoss, check_ensemble
from safe_rl.objectives.samples import require


class TD3Loss(QFunctionLoss, objectives.TD3Loss):
    """TorchRL's TD3 loss, split into critic and actor losses, with ensembles that need no vmap.

    Args:
        actor_network: Deterministic policy.
        qvalue_network: A `safe_rl.models.QEnsemble`.
        action_spec: Spec of one action [A], bounded.
        gamma: Discount per step, of reward and costs.
        policy_noise: Standard deviation of the noise on the target policy's actions, in units of
            half the range of actions.
        noise_clip: Bound of the noise on target actions, in units of half the range of actions.

    Examples:
        >>> from safe_rl.models import QEnsemble, make_bounded_actor
        >>> from torchrl.data import Bounded
        >>> actor = make_bounded_actor(3, -torch.ones(2), torch.ones(2), hidden_sizes=[8])
        >>> q = QEnsemble(3, 2, hidden_sizes=[8], num_networks=2)
        >>> settings = {"gamma": 0.99, "policy_noise": 0.2, "noise_clip": 0.5}
        >>> TD3Loss(actor, q, action_spec=Bounded(-1, 1, [2]), **settings).out_keys
        ['loss_qvalue', 'loss_actor', 'qvalue']
    """

    def __init__(
        self,
        actor_network: TensorDictModuleBase,
        qvalue_network: TensorDictModuleBase,
        *,
        action_spec: TensorSpec,
        gamma: Share,
        policy_noise: NonNegativeFloat,
        noise_clip: NonNegativeFloat,
    ) -> None:
        check_ensemble(qvalue_network, "Q function of rewards")
        super().__init__(
            actor_network,
            qvalue_network,
            action_spec=action_spec,
            num_qvalue_nets=0,
            policy_noise=policy_noise,
            noise_clip=noise_clip,
            loss_function="l2",
        )
        self.gamma = gamma
        self.make_value_estimator(ValueEstimators.TD0, gamma=gamma)
        self.out_keys = ["loss_qvalue", "loss_actor", "qvalue"]

    def _next_values(self, following: TensorDictBase) -> Tensor:
        action = self.smoothed_action(following)
        return self.q_values("qvalue_network", following, action, "target").min(0).values

    @torch.no_grad()
    def smoothed_action(self, steps: TensorDictBase) -> Tensor:
        """Actions of the target policy with noise, within their bounds, [..., A]."""
        action = self._act(steps, self.target_actor_network_params)
        half = (self.max_action - self.min_action) / 2
        largest = self.noise_clip * half
        noise = (torch.randn_like(action) * (self.policy_noise * half)).clamp(-largest, largest)
        return (action + noise).clamp(self.min_action, self.max_action)

    def _act(self, steps: TensorDictBase, params: TensorDictBase) -> Tensor:
        inputs = steps.select(*self.actor_network.in_keys, strict=False)
        failure = None
        # after an exception tensordict would leave these tensors in the policy
        with params.to_module(self.actor_network, preserve_module_state=False):
            try:
                action = self.actor_network(inputs).get(self.tensor_keys.action)
            except Exception as error:
                failure = error
        if failure is not None:
            raise failure
        return action

    def actor_losses(self, tensordict: TensorDictBase) -> TensorDict:
        """Loss of the policy, and the mean value of its actions."""
        action = self._act(tensordict, self.actor_network_params)
        values = self.q_values("qvalue_network", tensordict, action, "frozen").squeeze(-1)
        objective, reported = self.penalised(-values[0], tensordict, action)
        return TensorDict(
            loss_actor=self._mean(objective, tensordict),
            qvalue=self.of_samples(values.detach(), tensordict).mean(),
            **reported,
        )

    def value_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """The sum of `critic_losses`, and each of them, for scripts of TorchRL's TD3."""
        losses = self.critic_losses(tensordict)
        return sum(losses.values()), losses.detach().to_dict()

    def actor_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss of `actor_losses`, and its other entries, for scripts of TorchRL's TD3."""
        losses = self.actor_losses(tensordict).to_dict()
        return losses.pop("loss_actor"), losses


class TD3LagrangianLoss(CostCritics, TD3Loss):
    """TD3 on the Lagrangian: max_π E[Q_1 − r Σ_i w_i Q_i] / (1 + Σ_i λ_i), w = λ / u.

    `CostCritics` explains r and u. Arguments are those of `CostCritics` and `TD3Loss`.

    Examples:
        >>> from safe_rl.models import QEnsemble, make_bounded_actor
        >>> from safe_rl.objectives import LagrangeMultiplier
        >>> from torchrl.data import Bounded
        >>> actor = make_bounded_actor(3, -torch.ones(2), torch.ones(2), hidden_sizes=[8])
        >>> q = QEnsemble(3, 2, hidden_sizes=[8], num_networks=2)
        >>> cost_q = QEnsemble(3, 2, hidden_sizes=[8], num_networks=1, out_key="cost_value")
        >>> costs = {"multiplier": LagrangeMultiplier(25.0, init=1, lr=0.05), "cost_keys": ["cost"]}
        >>> settings = {"gamma": 0.99, "policy_noise": 0.2, "noise_clip": 0.5, **costs}
        >>> settings["action_spec"] = Bounded(-1, 1, [2])
        >>> TD3LagrangianLoss(actor, q, cost_q, **settings).out_keys[-2:]
        ['loss_cost_qvalue', 'cost_qvalue']
    """

    def critic_losses(self, tensordict: TensorDictBase) -> TensorDict:
        """Losses of the Q functions of reward and costs."""
        losses = super().critic_losses(tensordict)
        action = self.smoothed_action(tensordict.get("next"))
        return losses.set("loss_cost_qvalue", self.cost_qvalue_loss(tensordict, action))


class BCLoss(ReplayLoss):
    """Behaviour cloning: squared distance of a deterministic policy's actions from recorded ones.

    The loss reads neither costs nor rewards. If the steps are those of safe episodes, it is BC-Safe
    of Liu et al., *Datasets and Benchmarks for Offline Safe Reinforcement Learning* (2024).

    Args:
        actor_network: Deterministic policy, which writes the action alone.

    Raises:
        ValueError: If the policy writes more than the action, as a probabilistic one does.

    Examples:
        >>> from safe_rl.models import make_bounded_actor
        >>> actor = make_bounded_actor(3, -torch.ones(2), torch.ones(2), hidden_sizes=[8])
        >>> BCLoss(actor).in_keys
        ['observation', 'action']
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that `set_keys` accepts."""

        action: NestedKey = "action"  # of the recorded action, [..., A]; as the policy writes it

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys

    actor_network: TensorDictModuleBase
    actor_network_params: TensorDictParams
    target_actor_network_params: TensorDictParams
    reduction = "mean"

    def __init__(self, actor_network: TensorDictModuleBase) -> None:
        super().__init__()
        if len(actor_network.out_keys) != 1:
            raise ValueError(
                "actor_network must be deterministic, and write the action alone, not "
                f"{actor_network.out_keys}."
            )
        self.convert_to_functional(actor_network, "actor_network")
        self.set_keys(action=actor_network.out_keys[0])
        self.out_keys = ["loss_actor"]

    @property
    def in_keys(self) -> list[NestedKey]:
        """Entries of the steps that are read."""
        return [*self.actor_network.in_keys, self.tensor_keys.action]

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Evaluate the loss on steps [...]: a mean over steps and actions, without padding.

        Raises:
            KeyError: If an entry is missing; the message names it.
        """
        (key,) = self.actor_network.out_keys
        taken = require(tensordict, self.tensor_keys.action)
        inputs = tensordict.select(*self.actor_network.in_keys)
        with self.actor_network_params.to_module(self.actor_network):
            chosen = self.actor_network(inputs).get(key)
        error = mse_loss(chosen, taken, reduction="none")
        return TensorDict(loss_actor=self._reduce_loss(error, tensordict))
