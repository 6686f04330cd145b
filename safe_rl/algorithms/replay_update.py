"""Gradient updates on minibatches from a replay buffer, with target networks."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from itertools import chain
from typing import Annotated, Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.optim import Optimizer
from torchrl.objectives import SoftUpdate

from safe_rl.algorithms.losses import ESTIMATOR, divergence, sum_of_losses
from safe_rl.algorithms.replay_buffer import Memory
from safe_rl.naming import did_you_mean
from safe_rl.objectives.q_functions import ReplayLoss
from safe_rl.ranges import PART, Checked, Positive, Range


class ReplayUpdate(Checked):
    """Minimise the sum of all ``loss_*`` on minibatches, and update target networks.

    Args:
        loss: Loss on transitions of the buffer, with target networks unless ``tau`` is None.
        optimizer: Function of the parameters that builds the optimiser, for example
            ``functools.partial(torch.optim.Adam, lr=3e-4, fused=True)``.
        updates_per_step: Gradient steps per environment step (update-to-data ratio).
        tau: Weight τ of the new parameters in the target networks at every update (Polyak
            averaging); None without target networks.
        policy_delay: Updates of the critics per update of the policy and of the target networks.
        rates: Learning rates of parameters whose names begin with a key, such as ``log_alpha``; for
            others that of the optimiser.
        max_grad_norm: Norm to which the gradient is clipped, or None.
        compile: Whether to compile the losses with torch.compile.

    Raises:
        TypeError: If the loss is no `ReplayLoss`.
        ValueError: If an argument is outside its range, no parameter's name begins with a key of
            ``rates``, or the loss has target networks and ``tau`` is None.
        FloatingPointError: By the call, if a loss is not finite, before the step on this loss.

    Examples:
        >>> from functools import partial
        >>> from safe_rl.models import QEnsemble, make_squashed_actor
        >>> from safe_rl.objectives import SACLoss
        >>> actor = make_squashed_actor(3, -torch.ones(2), torch.ones(2), hidden_sizes=[8])
        >>> q = QEnsemble(3, 2, hidden_sizes=[8], num_networks=2)
        >>> loss = SACLoss(actor, q, gamma=0.99, alpha_init=0.1, target_entropy=-2.0)
        >>> adam = partial(torch.optim.Adam, lr=1e-3)
        >>> update = ReplayUpdate(loss, optimizer=adam, updates_per_step=1.0, tau=0.005)
        >>> update.due(10), update.due(10)
        (10, 10)
    """

    def __init__(
        self,
        loss: ReplayLoss,
        *,
        optimizer: Annotated[Callable[[Iterable[Any]], Optimizer], PART],
        updates_per_step: Positive,
        tau: Annotated[float, Range(0, 0.5, above=True)] | None,
        policy_delay: Annotated[int, Range(1, 10_000)] = 1,
        rates: Mapping[str, Positive] | None = None,
        max_grad_norm: Positive | None = None,
        compile: bool = False,
    ) -> None:
        if not isinstance(loss, ReplayLoss):
            raise TypeError(
                f"{type(loss).__module__}.{type(loss).__name__} is no loss on a replay buffer: use "
                "one of safe_rl.objectives, or derive it from its q_functions.ReplayLoss."
            )
        self.loss, self.policy_delay = loss, policy_delay
        self.updates_per_step, self.max_grad_norm = updates_per_step, max_grad_norm
        self.optimizer = optimizer(_groups(loss, rates or {}))
        self._parameters = list(loss.parameters())
        self._device = self._parameters[0].device
        # SoftUpdate equates the targets, and refuses losses without them; its own steps are slow
        self._share = 0.0 if tau is None else 1 - SoftUpdate(loss, tau=tau).eps
        pairs = loss.target_pairs()
        self._targets = [target.data for target, _ in pairs]
        self._sources = [source.data for _, source in pairs]
        if pairs and tau is None:
            raise ValueError(
                f"tau is null, but {type(loss).__name__} has target networks: they would never "
                "change. Set the step towards the networks, such as tau=0.01."
            )
        self._evaluate: Callable[..., tuple[Tensor, TensorDictBase]]
        self._evaluate = torch.compile(self._losses) if compile else self._losses
        self._counts = {"updates": 0, "owed": 0.0}

    @torch.no_grad()
    def equate_targets(self) -> None:
        """Copy the networks, whose weights have been replaced, into the target networks."""
        for target, source in zip(self._targets, self._sources, strict=True):
            target.copy_(source)

    def due(self, steps: int) -> int:
        """Gradient steps that are due after this number of environment steps."""
        owed = self._counts["owed"] + steps * self.updates_per_step
        self._counts["owed"] = owed - int(owed)
        return int(owed)

    def __call__(self, buffer: Memory, number: int) -> dict[str, Tensor]:
        """Take a number of gradient steps.

        Returns:
            Means over the steps (and over costs) of everything that the loss reports, NaN if there
            was no step; and ``num_updates``.
        """
        names = self.loss.out_keys
        nothing = torch.zeros((), device=self._device)
        sums, counts = nothing.repeat(len(names)), dict.fromkeys(names, 0)
        for minibatch in buffer.minibatches(number):
            with_actor = self._counts["updates"] % self.policy_delay == 0
            total, losses = self._evaluate(minibatch, with_actor)
            if not total.isfinite():
                raise divergence(losses)
            self._step(total, with_actor)
            buffer.learned(minibatch, self.loss.priority_key)
            with torch.no_grad():
                values = dict(losses.items())
                sums += torch.stack([values.get(name, nothing).mean() for name in names])
            counts = {name: count + (name in values) for name, count in counts.items()}
        means = sums.cpu() / torch.tensor([float(count) for count in counts.values()])
        return dict(zip(names, means, strict=True)) | {"num_updates": torch.tensor(float(number))}

    def _losses(self, minibatch: TensorDictBase, with_actor: bool) -> tuple[Tensor, TensorDictBase]:
        losses = self.loss(minibatch) if with_actor else self.loss.critic_losses(minibatch)
        return sum_of_losses(losses), losses

    def _step(self, total: Tensor, with_actor: bool) -> None:
        # `zero_grad` of the optimiser takes twenty times as long
        for parameter in self._parameters:
            parameter.grad = None
        total.backward()
        if self.max_grad_norm is not None:
            nn.utils.clip_grad_norm_(self._parameters, self.max_grad_norm)
        self.optimizer.step()
        if with_actor and self._targets:
            torch._foreach_lerp_(self._targets, self._sources, self._share)
        self._counts["updates"] += 1

    def _tensors(self) -> Iterator[tuple[str, Tensor]]:
        """Parameters and buffers of the loss, by name."""
        named = chain(self.loss.named_parameters(), self.loss.named_buffers())
        return ((name, tensor) for name, tensor in named if not name.startswith(ESTIMATOR))

    def state_dict(self) -> dict[str, Any]:
        """Optimiser, target networks and all other tensors of the loss."""
        return {
            "optimizer": self.optimizer.state_dict(),
            "loss": {name: tensor.detach().clone() for name, tensor in self._tensors()},
            "counts": dict(self._counts),
        }

    @torch.no_grad()
    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Continue from :meth:`state_dict`."""
        self.optimizer.load_state_dict(state_dict["optimizer"])
        stored = state_dict["loss"]
        for name, tensor in self._tensors():
            # TorchRL makes this constant when it first computes the loss: it may not be stored yet
            if name in stored or name != "_target_entropy":
                tensor.copy_(stored[name])
        self._counts.update(state_dict["counts"])


def _groups(loss: ReplayLoss, rates: Mapping[str, float]) -> list[dict[str, Any]]:
    """Groups of parameters for an optimiser: one per rate, and the others."""
    groups: dict[str, list[Tensor]] = {"": [], **{prefix: [] for prefix in rates}}
    for name, parameter in loss.named_parameters():
        if parameter.requires_grad:
            # the longest matching prefix
            groups[max(filter(name.startswith, rates), key=len, default="")].append(parameter)
    empty = [prefix for prefix in rates if not groups[prefix]]
    if empty:
        known = sorted({name.partition(".")[0] for name, _ in loss.named_parameters()})
        raise ValueError(
            f"rates names '{empty[0]}', but the loss has only {', '.join(known)}."
            f"{did_you_mean(empty[0], known)}"
        )
    return [
        {"params": group} | ({"lr": rates[prefix]} if prefix else {})
        for prefix, group in groups.items()
    ]
