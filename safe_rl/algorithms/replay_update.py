"""Gradient updates on minibatches from a replay buffer, with target networks."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from functools import partial
from itertools import chain
from typing import Annotated, Any

import torch
from annotated_types import Interval
from pydantic import PositiveFloat
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import CudaGraphModule
from torch import Tensor, nn
from torch.optim import Optimizer
from torchrl.objectives import SoftUpdate

from safe_rl.algorithms.losses import ESTIMATOR, divergence, sum_of_losses
from safe_rl.algorithms.replay_buffer import Memory
from safe_rl.checks import Checked
from safe_rl.naming import did_you_mean
from safe_rl.objectives.q_functions import ReplayLoss

_NO_GRAPH = (
    "If the loss reads numbers on the host (.item()) or branches on them (if), its gradient steps "
    "cannot be recorded as CUDA graphs: use policy_update.cuda_graph=false."
)


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
        cuda_graph: On a GPU, whether to record gradient steps as CUDA graphs, which take a fraction
            of the time. The loss's Python code then runs only in the first steps: use False if it
            reads numbers on the host (``.item()``) or has attributes that change during training.
            Steps of optimisers without a setting ``capturable``, such as SGD, are never recorded.

    Raises:
        TypeError: If the loss is not a `ReplayLoss`.
        ValueError: If an argument is outside its range, no parameter's name begins with a key of
            ``rates``, or the loss has target networks and ``tau`` is None.
        FloatingPointError: By the call, if a loss is not finite: before the step on this loss, or
            with CUDA graphs after the last step of the call.
        RuntimeError: By the call, if the steps cannot be recorded as CUDA graphs.

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
        optimizer: Callable[[Iterable[Any]], Optimizer],
        updates_per_step: PositiveFloat,
        tau: Annotated[float, Interval(gt=0, le=0.5)] | None,
        policy_delay: Annotated[int, Interval(ge=1, le=10_000)] = 1,
        rates: Mapping[str, PositiveFloat] | None = None,
        max_grad_norm: PositiveFloat | None = None,
        cuda_graph: bool = True,
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
        pairs = loss.target_pairs()
        if (tau is None) != (not pairs):
            advice = "no target networks: set it to null"
            if pairs:
                advice = "target networks, which would never change: set it to a step such as 0.01"
            raise ValueError(f"tau={tau}: {type(loss).__name__} has {advice}.")
        # SoftUpdate equates the targets; its own steps are slow
        self._share = 0.0 if tau is None else 1 - SoftUpdate(loss, tau=tau).eps
        self._pair_targets()
        # optimisers without this setting may count their steps in Python
        is_capturable = "capturable" in self.optimizer.defaults
        self._uses_graphs = cuda_graph and is_capturable and self._device.type == "cuda"
        self._reported: dict[bool, Collection[str]] = {}
        self._prepare_steps()
        self._counts = {"updates": 0, "owed": 0.0}

    def _pair_targets(self) -> None:
        """List the data of target networks, and of the networks that they follow."""
        pairs = self.loss.target_pairs()
        self._targets = [target.data for target, _ in pairs]
        self._sources = [source.data for _, source in pairs]

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._pair_targets()  # copies of the data would be apart from the copied networks

    def _prepare_steps(self) -> None:
        """Make the functions of a minibatch that take a step, with and without the actor."""
        for group in self.optimizer.param_groups:
            group["capturable"] = self._uses_graphs
        steps = {with_actor: partial(self._step, with_actor) for with_actor in (True, False)}
        if self._uses_graphs:
            with warnings.catch_warnings():
                # it removes TensorDicts from torch's pytrees, for the whole process
                warnings.filterwarnings("ignore", message="Tensordict is registered in PyTree")
                steps = {key: CudaGraphModule(f, device=self._device) for key, f in steps.items()}
        self._steps: Mapping[bool, Callable[[TensorDictBase], Tensor]] = steps

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
        sums, counts = torch.zeros(len(names), device=self._device), dict.fromkeys(names, 0)
        for minibatch in buffer.minibatches(number):
            with_actor = self._counts["updates"] % self.policy_delay == 0
            try:
                sums += self._steps[with_actor](minibatch)
            except RuntimeError as error:
                if self._uses_graphs:
                    error.add_note(_NO_GRAPH)
                raise
            self._counts["updates"] += 1
            reported = self._reported[with_actor]
            counts = {name: count + (name in reported) for name, count in counts.items()}
        sums = sums.cpu()
        if self._uses_graphs and not sums.isfinite().all():
            taken = "Steps have been taken on it: continue from a checkpoint."
            raise divergence(TensorDict(dict(zip(names, sums, strict=True))), taken)
        means = sums / torch.tensor([float(count) for count in counts.values()])
        return dict(zip(names, means, strict=True)) | {"num_updates": torch.tensor(float(number))}

    def _step(self, with_actor: bool, minibatch: TensorDictBase) -> Tensor:
        """Take a step. Returns the means of all that the loss can report, 0 of what it does not."""
        minibatch = minibatch.copy()  # losses may replace entries, but a graph reads the given ones
        losses = self.loss(minibatch) if with_actor else self.loss.critic_losses(minibatch)
        total = sum_of_losses(losses)
        is_capturing = self._uses_graphs and torch.cuda.is_current_stream_capturing()
        if not is_capturing and not total.isfinite():  # a capture computes nothing
            raise divergence(losses)
        # `zero_grad` of the optimiser takes twenty times as long
        for parameter in self._parameters:
            parameter.grad = None
        total.backward()
        if self.max_grad_norm is not None:
            nn.utils.clip_grad_norm_(self._parameters, self.max_grad_norm)
        self.optimizer.step()
        if with_actor and self._targets:
            torch._foreach_lerp_(self._targets, self._sources, self._share)
        values, nothing = dict(losses.items()), torch.zeros((), device=self._device)
        self._reported[with_actor] = list(values)
        with torch.no_grad():
            return torch.stack([values.get(k, nothing).mean() for k in self.loss.out_keys])

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
        """Continue from `state_dict`."""
        stored = dict(state_dict["optimizer"])
        # the saved run may have used another device
        stored["param_groups"] = [
            {**group, "capturable": self._uses_graphs} for group in stored["param_groups"]
        ]
        self.optimizer.load_state_dict(stored)
        self._prepare_steps()  # earlier graphs would use the optimiser's earlier tensors
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
