"""Loss of behaviour cloning."""

from __future__ import annotations

from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModuleBase, dispatch
from torchrl.objectives.utils import distance_loss

from safe_rl.objectives.q_functions import Distance, ReplayLoss
from safe_rl.objectives.samples import require


class BCLoss(ReplayLoss):
    """Distance of a deterministic policy's actions from those that were taken.

    Liu et al., *Datasets and Benchmarks for Offline Safe Reinforcement Learning* (2024), where the
    steps are those of safe episodes (BC-Safe). The loss reads neither costs nor rewards.

    Args:
        actor_network: deterministic policy.
        loss_function: Loss of the errors of actions.

    Examples:
        >>> import torch
        >>> from safe_rl.models import make_bounded_actor
        >>> actor = make_bounded_actor(3, -torch.ones(2), torch.ones(2), hidden_sizes=[8])
        >>> loss = BCLoss(actor)
        >>> steps = actor(TensorDict(observation=torch.randn(4, 3), batch_size=[4]))
        >>> loss(steps.detach())["loss_actor"]
        tensor(0., grad_fn=<MeanBackward0>)
    """

    learns_values = False

    actor_network: TensorDictModuleBase
    actor_network_params: TensorDictParams
    target_actor_network_params: TensorDictParams

    def __init__(
        self, actor_network: TensorDictModuleBase, *, loss_function: Distance = "l2"
    ) -> None:
        super().__init__()
        self.convert_to_functional(actor_network, "actor_network")
        self.loss_function = loss_function
        self.in_keys = [*actor_network.in_keys, *actor_network.out_keys]
        self.out_keys = ["loss_actor"]

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Evaluate the loss on steps [...]: a mean over steps and actions.

        Raises:
            KeyError: If an entry is missing; the message names it.
        """
        (key,) = self.actor_network.out_keys
        taken = require(tensordict, key)
        inputs = tensordict.select(*self.actor_network.in_keys)
        with self.actor_network_params.to_module(self.actor_network):
            chosen = self.actor_network(inputs).get(key)
        error = distance_loss(chosen, taken, loss_function=self.loss_function)
        return TensorDict(loss_actor=error.mean())
