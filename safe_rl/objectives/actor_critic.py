"""A joint loss of policy and critics, for TorchRL's trainers."""

from __future__ import annotations

from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from torchrl.objectives import LossModule

from safe_rl.objectives.advantages import VectorGAE
from safe_rl.objectives.critics import CriticLoss
from safe_rl.objectives.surrogate import SurrogateLoss


class ActorCriticLoss(LossModule):
    """Policy loss and critic loss in one module, for trainers with a single optimiser.

    One such trainer is `torchrl.trainers.algorithms.PPOTrainer`.

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
        critic = self.critic_loss(tensordict).items()
        weighed = {
            name: self.critic_coeff * value if name.startswith("loss_") else value
            for name, value in critic
        }
        return TensorDict({**self.policy_loss(tensordict), **weighed})
