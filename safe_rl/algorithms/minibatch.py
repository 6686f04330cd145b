"""Gradient updates of policies and critics: passes over one batch in minibatches."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any

import torch
from annotated_types import Interval
from pydantic import PositiveFloat, PositiveInt
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torch.optim import Optimizer
from torchrl.objectives import LossModule

from safe_rl.algorithms.algorithm_contract import PolicyUpdate
from safe_rl.algorithms.losses import divergence, estimates_read, reported_kl, sum_of_losses
from safe_rl.checks import Share, Weight, checked
from safe_rl.objectives.limits import LimitState
from safe_rl.objectives.multipliers import Multiplier
from safe_rl.objectives.policy_projections import CUPLoss
from safe_rl.objectives.samples import learning_samples, mask_keys
from safe_rl.objectives.surrogate import SurrogateLoss


@checked
@dataclass(frozen=True, kw_only=True)
class KLAdaptiveRate:
    """Lower the learning rate if max_kl ends updates early, raise it if the KL stays small.

    If the bound on the KL divergence ends an update after a few steps, the update has used the
    gradients of only a few minibatches. With a lower learning rate it averages over all
    minibatches. This matters with large multipliers, whose cost gradients are noisy. The idea is
    the adaptive penalty of PPO (Schulman et al. 2017, section 4), applied to the learning rate.

    Attributes:
        factor: Factor by which the rate is divided or multiplied.
        lowest: Lower bound of the rate.
        highest: Upper bound of the rate.
        few_steps: Share of the planned steps; after an update with fewer, the rate is lowered.
        low_kl: Share of the KL bound; if a whole update stays below, the rate is raised.

    Examples:
        >>> shares = {"few_steps": 0.5, "low_kl": 0.5}
        >>> adapt = KLAdaptiveRate(factor=2.0, lowest=1e-5, highest=1e-3, **shares)
        >>> adapt(4e-4, share_of_steps=0.2, share_of_kl=1.1)
        0.0002
    """

    factor: Annotated[float, Interval(gt=1)]
    lowest: Annotated[float, Interval(gt=0, le=1000)]
    highest: Annotated[float, Interval(gt=0, le=1000)]
    few_steps: Share
    low_kl: Share

    def __call__(self, rate: float, *, share_of_steps: float, share_of_kl: float) -> float:
        """The next rate, from shares of the planned steps and of the bound on the KL divergence."""
        if share_of_steps < self.few_steps:
            rate = rate / self.factor
        elif share_of_steps >= 1 and share_of_kl < self.low_kl:
            rate = rate * self.factor
        return min(max(rate, self.lowest), self.highest)


class MinibatchUpdate(PolicyUpdate):
    """Several passes of gradient steps over one batch, minimising the sum of all ``loss_*``.

    Every pass shuffles the batch once and cuts it into minibatches of equal size, close to
    ``minibatch_size``. Remaining samples (fewer than there are minibatches) are not used in this
    pass. For a recurrent policy, whole sequences are shuffled instead of samples.

    ``max_kl`` is for early stopping: if the ``kl`` that the loss reports exceeds it, the update
    ends. The KL is computed on the current minibatch before its step, so the check takes no extra
    time. With minibatches of thousands of states its error is a few percent. The step on this
    minibatch is not taken, unless ``step_beyond_kl`` is set. The code of Ray, Achiam, Amodei (2019)
    takes it, but measures the KL on the full batch.

    If the KL exceeds ``max_kl`` before the first step, because a very different policy collected
    the batch, and ``step_beyond_kl`` is not set, no step is taken and a warning says so. Before the
    first step, the method ``prepare`` of a `SurrogateLoss` gets the batch and the limits.

    Args:
        loss: Loss module. It gets the entries of the batch that its ``in_keys`` name, and the
            advantages, value targets and values that its other keys name.
        optimizer: Function of the parameters that builds the optimiser, for example
            ``functools.partial(torch.optim.Adam, lr=3e-4, fused=True)``.
        num_passes: Number of passes over the batch.
        minibatch_size: Samples per gradient step; None takes the whole batch.
        max_kl: Mean KL divergence above which the update ends, or None.
        step_beyond_kl: Whether to take one more step when the KL has been found to exceed
            ``max_kl``. Then an update on data of the current policy has at least two steps.
        max_grad_norm: Norm to which the gradient is clipped, or None.
        adapt_rate: Computes the learning rate of the next call from the number of steps and the KL
            of this one; None for a constant rate. It needs ``max_kl``.
        compile: Whether to compile the loss and its gradient with torch.compile.

    Raises:
        ValueError: If an argument is outside its range, or ``adapt_rate`` is set without
            ``max_kl``. By the call, if ``max_kl`` is set and the loss reports no scalar ``kl``.
        FloatingPointError: By the call, if an entry of the batch is not finite, before any step; or
            if a loss is not finite, before the step on this loss.

    Examples:
        >>> from functools import partial
        >>> from safe_rl.models import make_critic
        >>> from safe_rl.objectives import CriticLoss
        >>> loss, adam = CriticLoss(make_critic(3, hidden_sizes=[8])), partial(torch.optim.Adam)
        >>> update = MinibatchUpdate(loss, optimizer=adam, num_passes=2, minibatch_size=5)
        >>> batch = TensorDict(observation=torch.ones(4, 5, 3), value_target=torch.ones(4, 5, 1))
        >>> update(batch.auto_batch_size_(2))["num_steps"]
        tensor(8)
    """

    state_names: tuple[str, ...] = ("optimizer", "_generator")

    def __init__(
        self,
        loss: LossModule,
        *,
        optimizer: Callable[[Iterable[nn.Parameter]], Optimizer],
        num_passes: Annotated[int, Interval(ge=1, le=10**9)],
        minibatch_size: PositiveInt | None,
        max_kl: PositiveFloat | None = None,
        step_beyond_kl: bool = False,
        max_grad_norm: PositiveFloat | None = None,
        adapt_rate: KLAdaptiveRate | None = None,
        compile: bool = False,
    ) -> None:
        if adapt_rate is not None and max_kl is None:
            raise ValueError("adapt_rate follows the KL divergence: it needs a max_kl.")
        self.loss = loss
        self.num_passes = num_passes
        self.minibatch_size = minibatch_size
        self.max_kl = max_kl
        self.step_beyond_kl = step_beyond_kl
        self.max_grad_norm = max_grad_norm
        self.adapt_rate = adapt_rate
        self._parameters = [parameter for parameter in loss.parameters() if parameter.requires_grad]
        self.optimizer = optimizer(self._parameters)
        self._evaluate = torch.compile(self._total_loss) if compile else self._total_loss
        # its own generator: an update in another thread must not change its draws
        self._generator = torch.Generator().manual_seed(torch.initial_seed())

    def __call__(
        self, batch: TensorDictBase, limits: LimitState | None = None
    ) -> dict[str, Tensor]:
        """Take the gradient steps on ``batch``, of any shape; padding is not used.

        Returns:
            Means over the steps of everything that the loss reports, except for ``kl``. This is the
            last measured value. It is measured after the last step if ``max_kl`` ended the update
            without ``step_beyond_kl``, and before the last step otherwise. Also ``num_steps``, the
            number of gradient steps, and ``lr``, the next learning rate, if it is adapted.
        """
        history: list[TensorDictBase] = []
        num_steps = 0
        if isinstance(self.loss, SurrogateLoss):
            self.loss.prepare(batch, limits)
        samples = self._samples(batch)
        for minibatch in self._minibatches(samples):
            total, losses = self._evaluate(minibatch)
            history.append(losses.detach())
            ends = self.max_kl is not None and bool(reported_kl(losses) > self.max_kl)
            if ends and not self.step_beyond_kl:
                break
            if not total.isfinite():
                raise divergence(losses)
            self._step(total)
            num_steps += 1
            if ends:
                break
        diagnostics = self._diagnostics(history, num_steps)
        if not num_steps:
            warnings.warn(
                f"No gradient step was taken: the KL divergence from the policy that collected the "
                f"batch is {float(diagnostics['kl']):.3g} before the first one, beyond "
                f"max_kl={self.max_kl}. Collect with the present policy, or raise max_kl.",
                stacklevel=2,
            )
        if self.adapt_rate is not None:
            planned = self.num_passes * self._num_minibatches(samples)
            diagnostics["lr"] = self._next_rate(num_steps / planned, diagnostics["kl"])
        return diagnostics

    def _samples(self, batch: TensorDictBase) -> TensorDictBase:
        """Entries of a batch that the loss reads, without padding; refuses non-finite entries."""
        keys = [*self.loss.in_keys, *mask_keys(self.loss), *estimates_read(self.loss)]
        return learning_samples(batch.select(*keys, strict=False), self.loss.in_keys, self.loss)

    def _next_rate(self, share_of_steps: float, kl: Tensor) -> Tensor:
        """Adapt the learning rate after an update, if it took a step, and return the rate."""
        if self.adapt_rate is not None and self.max_kl is not None and share_of_steps:
            shares = {"share_of_steps": share_of_steps, "share_of_kl": float(kl) / self.max_kl}
            for group in self.optimizer.param_groups:
                group["lr"] = self.adapt_rate(group["lr"], **shares)
        return torch.tensor(self.optimizer.param_groups[0]["lr"])

    def _num_minibatches(self, samples: TensorDictBase) -> int:
        number = samples.numel()
        size = number if self.minibatch_size is None else self.minibatch_size
        # there may be fewer sequences than minibatches: sequences are not divided
        return max(1, min(round(number / size), samples.shape[0]))

    def _minibatches(self, samples: TensorDictBase) -> Iterator[TensorDictBase]:
        rows = samples.shape[0]
        num_minibatches = self._num_minibatches(samples)
        size = rows // num_minibatches
        for _ in range(self.num_passes):
            if num_minibatches == 1:
                yield samples
                continue
            order = torch.randperm(rows, generator=self._generator).to(samples.device)
            # three times as fast as indexing
            shuffled = samples.apply(partial(torch.index_select, dim=0, index=order))
            for start in range(0, size * num_minibatches, size):
                yield shuffled[start : start + size]

    def _total_loss(self, minibatch: TensorDictBase) -> tuple[Tensor, TensorDictBase]:
        losses = self.loss(minibatch)
        return sum_of_losses(losses), losses

    def _step(self, total: Tensor) -> None:
        self.optimizer.zero_grad(set_to_none=True)
        total.backward()
        if self.max_grad_norm is not None:
            nn.utils.clip_grad_norm_(self._parameters, self.max_grad_norm)
        self.optimizer.step()

    @staticmethod
    def _diagnostics(history: list[TensorDictBase], num_steps: int) -> dict[str, Tensor]:
        steps = TensorDict.stack(history)
        means: dict[str, Tensor] = steps.float().mean(0).to_dict()
        # where the update ends, the others being means over its steps: a mean of the predicted
        # change would be about half of it
        last = {name: steps[name][-1] for name in ("kl", "cost_surrogate") if name in means}
        return means | last | {"num_steps": torch.tensor(num_steps)}

    def loss_modules(self) -> dict[str, nn.Module]:
        """The loss."""
        return {"loss": self.loss}


class CUPUpdate(MinibatchUpdate):
    """The two updates of CUP (Yang et al. 2022): one for the reward, then a projection.

    The first minimises the given loss, usually `PPOLoss`. The second minimises a `CUPLoss`, which
    lowers the costs near the policy that the first has reached. Diagnostics of the projection are
    called ``projection_…``, except for ``cost_surrogate``.

    Args:
        loss: Loss of the first update.
        multiplier: Multiplier with one ν per cost.
        gamma: Discount γ of the cost advantages.
        lmbda: Decay λ_GAE of the TD errors in the cost advantages.
        settings: Those of both updates, see `MinibatchUpdate`. The projection's learning rate is
            constant: with ν = 0 its KL stays small, and the rate would only rise.

    Examples:
        >>> from functools import partial
        >>> from safe_rl.models import make_actor
        >>> from safe_rl.objectives import PPOLoss, ProjectedMultiplier
        >>> actor = make_actor(3, 2, hidden_sizes=[8], initial_log_std=-0.5)
        >>> loss = PPOLoss(actor, clip_epsilon=0.2, entropy_coeff=0.0)
        >>> multiplier = ProjectedMultiplier({"cost": 25.0}, init=0.5, lr=0.01, highest=2.0)
        >>> settings = {"optimizer": partial(torch.optim.Adam, lr=1e-3), "minibatch_size": None}
        >>> update = CUPUpdate(loss, multiplier, gamma=0.99, lmbda=0.97, num_passes=2, **settings)
        >>> list(update.loss_modules())
        ['loss', 'loss.projection']
    """

    state_names = (*MinibatchUpdate.state_names, "projection")

    def __init__(
        self,
        loss: SurrogateLoss,
        multiplier: Multiplier,
        *,
        gamma: Weight,
        lmbda: Share,
        **settings: Any,
    ) -> None:
        super().__init__(loss, **settings)
        actor = loss.actor_network
        projection = CUPLoss(actor, multiplier, gamma=gamma, lmbda=lmbda, entropy_coeff=0.0)
        self.projection = MinibatchUpdate(projection, **(settings | {"adapt_rate": None}))

    def __call__(
        self, batch: TensorDictBase, limits: LimitState | None = None
    ) -> dict[str, Tensor]:
        """Take both updates on a batch; see `MinibatchUpdate`."""
        metrics = super().__call__(batch, limits)
        projected = self.projection(batch, limits)
        predicted = {"cost_surrogate": projected.pop("cost_surrogate")}
        return metrics | {f"projection_{k}": v for k, v in projected.items()} | predicted

    def loss_modules(self) -> dict[str, nn.Module]:
        """The losses of both updates."""
        return {"loss": self.loss, "loss.projection": self.projection.loss}
