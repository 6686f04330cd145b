"""Policies that fill a memory: at random at first, then an actor's, with noise if it has none."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule, TensorDictModuleBase
from torch import Tensor
from torchrl.envs.utils import exploration_type
from torchrl.modules import TanhNormal

from safe_rl.models.behaviour import WITHOUT_NOISE

__all__ = ["ExploringPolicy"]


class ExploringPolicy(TensorDictModuleBase):
    """What a collector steps with: the actor's actions, or uniformly random ones in the beginning.

    It shares the actor's parameters and writes nothing but the action, without distribution
    objects. Of a squashed Gaussian it samples; to the actions of a deterministic actor it adds
    Gaussian noise. Under ``set_exploration_type`` with ``DETERMINISTIC``, ``MODE`` or ``MEAN`` the
    action is the actor's own: the tanh of the Gaussian's mean.

    Args:
        actor: What :func:`~safe_rl.models.make_squashed_actor` or
            :func:`~safe_rl.models.make_bounded_actor` makes.
        low: Lower bounds of the action, [A].
        high: Upper bounds of the action, [A].
        noise: Standard deviation of the noise that is added to a deterministic actor's actions, in
            halves of the range of an action.

    Attributes:
        is_random: Whether actions are uniformly random; a buffer, that collectors' workers get with
            the weights.

    Raises:
        TypeError: If the actor is neither kind.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from safe_rl.models import make_squashed_actor
        >>> bounds = -torch.ones(2), torch.ones(2)
        >>> policy = ExploringPolicy(make_squashed_actor(3, *bounds, hidden_sizes=[8]), *bounds)
        >>> policy.is_random.fill_(True)
        tensor(True)
        >>> policy(TensorDict({"observation": torch.zeros(5, 3)}, [5]))["action"].shape
        torch.Size([5, 2])
    """

    low: Tensor
    high: Tensor
    is_random: Tensor

    def __init__(
        self,
        actor: ProbabilisticTensorDictSequential | TensorDictModule,
        low: Tensor,
        high: Tensor,
        *,
        noise: float = 0.0,
    ) -> None:
        super().__init__()
        parameters, self._samples = actor, False
        if isinstance(actor, ProbabilisticTensorDictSequential):
            parameters, sampler = actor.module[0], actor.module[-1]
            self._samples = True
            is_squashed = issubclass(sampler.distribution_class, TanhNormal)
            if len(actor.module) != 2 or not is_squashed:
                raise TypeError(
                    "ExploringPolicy samples a network followed by a TanhNormal, got "
                    f"{len(actor.module)} modules and {sampler.distribution_class.__name__}."
                )
        self.network, self.noise = parameters.module, noise
        self.in_keys = list(parameters.in_keys)
        self.out_keys = list(actor.out_keys[-1:] if not self._samples else sampler.out_keys[:1])
        device = next(actor.parameters()).device
        self.register_buffer("low", low.to(device), persistent=False)
        self.register_buffer("high", high.to(device), persistent=False)
        self.register_buffer(
            "is_random", torch.zeros((), dtype=torch.bool, device=device), persistent=False
        )

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action."""
        outputs = self.network(tensordict.get(self.in_keys[0]))
        is_noisy = exploration_type() not in WITHOUT_NOISE
        half = (self.high - self.low) / 2
        if self._samples:
            loc, scale = outputs
            inner = torch.addcmul(loc, scale, torch.randn_like(loc)) if is_noisy else loc
            action = self.low + half * (1 + inner.tanh())
        elif is_noisy and self.noise:
            action = outputs + self.noise * half * torch.randn_like(outputs)
            action = action.clamp(self.low, self.high)
        else:
            action = outputs
        if is_noisy:
            uniform = self.low + 2 * half * torch.rand_like(action)
            action = torch.where(self.is_random, uniform, action)
        return tensordict.set(self.out_keys[0], action)
