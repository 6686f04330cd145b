"""Policies for data collection without distribution objects, and one that holds its actions."""

from __future__ import annotations

import math

import torch
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, exploration_type, set_exploration_type
from torchrl.modules import IndependentNormal

from safe_rl.models.networks import Chain
from safe_rl.models.replay_networks import SquashedNormal
from safe_rl.naming import STEPS_TAKEN


def make_behaviour(actor: ProbabilisticTensorDictSequential) -> TensorDictModuleBase:
    """Return a `BehaviourPolicy` of an actor, which is faster, or the actor itself."""
    parameters, sampler = actor.module[0], actor.module[-1]
    # the order of the outputs of other networks is not known
    is_ours = len(actor.module) == 2 and isinstance(getattr(parameters, "module", None), Chain)
    is_plain = is_ours and sampler.distribution_class is IndependentNormal
    return BehaviourPolicy(actor) if is_plain else actor


WITHOUT_NOISE = (ExplorationType.DETERMINISTIC, ExplorationType.MODE, ExplorationType.MEAN)
"""Exploration types under which policies act without noise."""


class BehaviourPolicy(TensorDictModuleBase):
    """Sample a Gaussian actor in one module, without distribution objects.

    It shares the actor's parameters and writes the same entries: ``loc``, ``scale``, the action and
    its log-probability. With small batches, an actor spends most of its time on building
    distributions and calling nested modules, which this class leaves out. Under
    ``set_exploration_type`` with ``DETERMINISTIC``, ``MODE`` or ``MEAN``, the action is ``loc``.

    Args:
        actor: Policy made by `make_actor`, or by `assemble_actor` with the head "gaussian".

    Examples:
        >>> from safe_rl.models import make_actor
        >>> BehaviourPolicy(make_actor(3, 2, hidden_sizes=[8], initial_log_std=-0.5)).out_keys
        ['loc', 'scale', 'action', 'action_log_prob']
    """

    def __init__(self, actor: ProbabilisticTensorDictSequential) -> None:
        super().__init__()
        parameters, sampler = actor.module[0], actor.module[-1]
        self.network = parameters.module
        self.in_keys = list(parameters.in_keys)
        self.out_keys = [*parameters.out_keys, *sampler.out_keys]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the distribution's parameters, the action and its log-probability."""
        loc, scale = self.network(*(tensordict.get(key) for key in self.in_keys))
        is_noisy = exploration_type() not in WITHOUT_NOISE
        noise = torch.randn_like(loc) if is_noisy else torch.zeros_like(loc)
        # log N(loc + scale * noise; loc, scale) in terms of the noise
        log_prob = -0.5 * noise.square().sum(-1) - scale.log().sum(-1)
        log_prob = log_prob - 0.5 * math.log(2 * math.pi) * loc.shape[-1]
        outputs = (loc, scale, torch.addcmul(loc, scale, noise), log_prob)
        for key, value in zip(self.out_keys, outputs, strict=True):
            tensordict.set(key, value)
        return tensordict


class ExploringPolicy(TensorDictModuleBase):
    """Policy of off-policy collection: the actor's actions, or uniformly random ones at first.

    It shares the actor's parameters and writes only the action, without distribution objects. It
    samples from a squashed Gaussian actor, and adds Gaussian noise to the actions of a
    deterministic one. Under ``set_exploration_type`` with ``DETERMINISTIC``, ``MODE`` or ``MEAN``,
    the action is that of the deterministic actor, or the tanh of the Gaussian's mean. Policies of
    other distributions or several modules act by themselves, which takes more time.

    Args:
        actor: A policy, such as of `safe_rl.models.make_squashed_actor` or
            `safe_rl.models.make_bounded_actor`.
        low: Lower bounds of the action, [A].
        high: Upper bounds of the action, [A].
        noise: Standard deviation of the noise of a deterministic actor, as a fraction of half the
            action's range.

    Attributes:
        samples: Whether the actor samples its actions, and gets no noise.
        is_random: Whether actions are uniformly random. It is a buffer, so the workers of a
            collector receive it with the weights.

    Examples:
        >>> from safe_rl.models import make_squashed_actor
        >>> bounds = -torch.ones(2), torch.ones(2)
        >>> policy = ExploringPolicy(make_squashed_actor(3, *bounds, hidden_sizes=[8]), *bounds)
        >>> policy.is_random.fill_(True)
        tensor(True)
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
        self.samples = isinstance(actor, ProbabilisticTensorDictSequential)
        network, sampler = (actor.module[0], actor.module[-1]) if self.samples else (actor, actor)
        is_known = not self.samples or (
            len(actor.module) == 2 and sampler.distribution_class is SquashedNormal
        )
        is_plain = is_known and not isinstance(network.module, nn.ModuleList)
        self.network: nn.Module | None = network.module if is_plain else None
        self.actor, self.noise = None if is_plain else actor, noise
        self.in_keys = list(network.in_keys if is_plain else actor.in_keys)
        # of a sampler, the log-probability comes second
        self.out_keys = ["action"] if "action" in actor.out_keys else list(sampler.out_keys[:1])
        device = next(actor.parameters()).device
        for name, value in (("low", low), ("high", high), ("is_random", torch.tensor(False))):
            self.register_buffer(name, value.to(device), persistent=False)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action."""
        is_noisy = exploration_type() not in WITHOUT_NOISE
        half = (self.high - self.low) / 2
        if self.network is None:
            assert self.actor is not None
            # its own default may be to act without noise
            with set_exploration_type(exploration_type() or ExplorationType.RANDOM):
                action = self.actor(tensordict.select(*self.in_keys)).get(self.out_keys[0])
        elif self.samples:
            loc, scale = self.network(*map(tensordict.get, self.in_keys))
            inner = torch.addcmul(loc, scale, torch.randn_like(loc)) if is_noisy else loc
            action = self.low + half * (1 + inner.tanh())
        else:
            action = self.network(*map(tensordict.get, self.in_keys))
        if is_noisy and self.noise and not self.samples:
            action = action + self.noise * half * torch.randn_like(action)
            action = action.clamp(self.low, self.high)
        if is_noisy:
            uniform = self.low + 2 * half * torch.rand_like(action)
            action = torch.where(self.is_random, uniform, action)
        return tensordict.set(self.out_keys[0], action)


class HeldActions(TensorDictModuleBase):
    """A policy that decides at every k-th step and repeats its action in between.

    It is how a policy that was trained with the transform `ActionRepeat` acts in the environment
    itself, step by step: both have the same episodes. In an environment with that transform, which
    writes `steps_taken`, it decides at every call. Call `reset` when an episode begins, unless the
    environment writes `is_init`.

    Args:
        policy: The policy that decides; the state of a recurrent one is held, too.
        k: Steps for which an action is held.

    Examples:
        >>> from tensordict import TensorDict
        >>> from safe_rl.models import make_actor
        >>> policy = HeldActions(make_actor(3, 2, hidden_sizes=[8], initial_log_std=-0.5), k=2)
        >>> steps = [TensorDict(observation=torch.randn(5, 3), batch_size=[5]) for _ in range(3)]
        >>> first, second, third = (policy(step)["action"] for step in steps)
        >>> bool((first == second).all()), bool((second == third).any())
        (True, False)
    """

    def __init__(self, policy: TensorDictModuleBase, k: int) -> None:
        super().__init__()
        self.policy, self.k = policy, k
        states = [key for key in policy.out_keys if isinstance(key, tuple) and key[0] == "next"]
        self.in_keys, self.out_keys = list(policy.in_keys), ["action", *states]
        self._taken: Tensor | None = None  # steps of the present decisions, [N]
        self._held: TensorDictBase | None = None

    def reset(self, rows: Tensor | None = None) -> None:
        """Decide anew at the next step, in all rows or in those of a mask, bool [N]."""
        if rows is None or self._taken is None:
            self._taken = None
        else:
            self._taken = self._taken.masked_fill(rows.reshape(self._taken.shape), 0)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action."""
        if tensordict.get(STEPS_TAKEN, None) is not None:
            decided: TensorDictBase = self.policy(tensordict)
            return decided
        shape = tensordict.batch_size
        if self._taken is None or self._taken.shape != shape:
            self._taken = torch.zeros(shape, dtype=torch.int64, device=tensordict.device)
        if (begins := tensordict.get("is_init", None)) is not None:
            self.reset(begins)
        decides = self._taken % self.k == 0
        if decides.any():
            chosen = self.policy(tensordict.select(*self.in_keys)).select(*self.out_keys)
            if self._held is not None and not decides.all():
                chosen = torch.where(decides, chosen, self._held)
            self._held = chosen
        assert self._held is not None  # the first step decides
        self._taken = self._taken + 1
        return tensordict.update(self._held.copy())
