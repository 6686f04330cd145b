"""Base of all policy losses: importance ratios, the Lagrangian, and diagnostics."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from pydantic import NonNegativeFloat
from tensordict import NestedKey, TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import CompositeDistribution, ProbabilisticTensorDictSequential, dispatch
from torch import Tensor
from torch.distributions import Distribution

from safe_rl.checks import Checked
from safe_rl.objectives.distributions import entropy, kl, sampler_of
from safe_rl.objectives.limits import LimitState
from safe_rl.objectives.multipliers import Multiplier
from safe_rl.objectives.samples import SharesTensors, inputs_of, require, sample_mask


def effective_sample_size(log_weight: Tensor, mask: Tensor | None = None) -> Tensor:
    """Kish's effective sample size of importance weights, as a fraction of the unmasked samples."""
    log_weight = log_weight.flatten()
    if mask is not None:
        log_weight = torch.where(mask.flatten(), log_weight, -torch.inf)
    log_size = 2 * log_weight.logsumexp(0) - (2 * log_weight).logsumexp(0)
    return log_size.exp() / (log_weight.numel() if mask is None else mask.sum())


class SurrogateLoss(Checked, SharesTensors):
    """Base of the policy losses: subclasses turn log-ratios into surrogates.

    It reads a batch of any shape, [B] or [N, T], with normalised advantages; padding is ignored. It
    writes ``loss_objective`` and ``loss_entropy`` (to minimise), and the detached scalars ``kl``,
    ``entropy`` and ``ESS``. ``kl`` is the mean over states of KL(π_θ ‖ π_k), where the batch has
    the parameters of π_k. Policies may have any distribution. Divergence and entropy are computed
    in closed form if there is one, else they are estimated from samples.

    Args:
        actor_network: Policy with `get_dist`, such as a `torchrl.modules.ProbabilisticActor`.
        entropy_coeff: Factor of the entropy bonus. It is a buffer, so that it can be scheduled,
            even if it is 0 at first.

    Raises:
        TypeError: If the policy samples several entries, as one with a composite distribution does.
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that `set_keys` accepts.

        Other parameters of the behaviour policy are read where the actor writes them.
        """

        advantage: NestedKey = "advantage"  # of the reward, [..., 1]
        cost_advantage: NestedKey = "cost_advantage"  # [..., k]; read if the loss has costs
        action: NestedKey = "action"  # [..., n]
        sample_log_prob: NestedKey = "action_log_prob"  # under the behaviour policy, [...]
        loc: NestedKey = "loc"  # mean of the behaviour policy, [..., n]
        scale: NestedKey = "scale"  # its standard deviation, [..., n]

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    _schedulable_buffers = frozenset({"entropy_coeff"})
    reduction = "mean"  # may be set to "sum" or "none"

    actor_network: ProbabilisticTensorDictSequential
    actor_network_params: TensorDictParams
    target_actor_network_params: TensorDictParams
    entropy_coeff: Tensor

    _behaviour_hint = "It is the behaviour policy's, stored when the action was sampled."
    #: Entries of the batch that a subclass reads besides those of `in_keys`.
    extra_in_keys: tuple[NestedKey, ...] = ()
    #: Entries besides ``loss_objective`` that a subclass adds.
    extra_out_keys: tuple[str, ...] = ()

    def __init__(
        self, actor_network: ProbabilisticTensorDictSequential, *, entropy_coeff: NonNegativeFloat
    ) -> None:
        super().__init__()
        self.convert_to_functional(actor_network, "actor_network")
        self.multiplier: Multiplier | None = None
        self._limits: LimitState | None = None
        self.register_coeff_buffer("entropy_coeff", entropy_coeff, device=self._default_device)
        sampler = sampler_of(actor_network)
        kind = getattr(sampler, "distribution_class", None)
        is_composite = getattr(kind, "func", kind) is CompositeDistribution
        if is_composite or len(sampler.dist_sample_keys) > 1:
            raise TypeError(
                f"actor_network samples {sampler.dist_sample_keys}: losses take policies that "
                "sample one entry, so no composite distributions. Join the parts of the action."
            )
        names = [name if isinstance(name, str) else name[-1] for name in sampler.dist_keys]
        self._parameter_keys = dict(zip(names, sampler.in_keys, strict=True))
        self.set_keys(**{k: v for k, v in self._parameter_keys.items() if k in ("loc", "scale")})
        self.out_keys = [
            "loss_objective", "loss_entropy", *self.extra_out_keys, "kl", "entropy", "ESS",
        ]  # fmt: skip

    @property
    def has_costs(self) -> bool:
        """Whether cost advantages are read."""
        return self.multiplier is not None

    def prepare(self, batch: TensorDictBase, limits: LimitState | None = None) -> TensorDictBase:
        """Prepare for the gradient steps on a batch, and return the batch.

        Call it with every batch, before the first step; a `safe_rl.algorithms.MinibatchUpdate` does
        so. A loss with costs keeps the state of the limits after this batch.
        """
        if self.has_costs:
            self._limits = limits
        return batch

    @property
    def limits(self) -> LimitState:
        """State of the limits after the batch; ValueError if `prepare` was called without it."""
        if self._limits is None:
            raise ValueError(
                f"{type(self).__name__} needs the state of the limits: call prepare(batch, limits) "
                "with every batch, before its first step, and what Constraints.update returns."
            )
        return self._limits

    @property
    def behaviour_keys(self) -> dict[NestedKey, NestedKey]:
        """Key of each parameter of the behaviour policy in the batch, by the actor's key.

        Mean and standard deviation can have other keys: ``set_keys(loc=…, scale=…)``.
        """
        moved = {"loc": self.tensor_keys.loc, "scale": self.tensor_keys.scale}
        return {key: moved.get(name, key) for name, key in self._parameter_keys.items()}

    @property
    def in_keys(self) -> list[NestedKey]:
        """Entries of the batch that are read."""
        keys = self.tensor_keys
        costs = [keys.cost_advantage] if self.has_costs else []
        behaviour = [keys.action, keys.sample_log_prob, *self.behaviour_keys.values()]
        read = [*self.actor_network.in_keys, *behaviour, keys.advantage, *costs]
        return [*read, *self.extra_in_keys]

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Evaluate the loss on a batch, which is not changed.

        Raises:
            KeyError: If an entry is missing.
            ValueError: If advantages do not match log-probabilities or multipliers in shape, or
                the batch was not collected under ``torch.no_grad()``.
        """
        # A copy: actors write their loc and scale, which in the batch are the behaviour policy's.
        observed = inputs_of(self.actor_network, tensordict)
        with self.actor_network_params.to_module(self.actor_network, preserve_module_state=False):
            distribution = self.actor_network.get_dist(observed)
        log_weight = self._log_weight(tensordict, distribution)
        bonus = entropy(distribution)
        divergence = self._kl(tensordict, distribution, log_weight)
        out = self._evaluate(tensordict, log_weight, divergence.unsqueeze(-1))
        out["loss_objective"] = self._reduce_loss(out["loss_objective"].squeeze(-1), tensordict)
        out["loss_entropy"] = -self.entropy_coeff * self._reduce_loss(bonus, tensordict)
        out["kl"] = self._reduce_loss(divergence.detach(), tensordict, reduction="mean")
        out["entropy"] = self._reduce_loss(bonus.detach(), tensordict, reduction="mean")
        out["ESS"] = effective_sample_size(log_weight.detach(), sample_mask(tensordict, self))
        losses = TensorDict(out)
        self._clear_weakrefs(
            tensordict, losses, "actor_network_params", "target_actor_network_params"
        )
        return losses

    def _evaluate(
        self, tensordict: TensorDictBase, log_weight: Tensor, divergence: Tensor
    ) -> dict[str, Tensor]:
        """`_surrogates`; losses that need the divergence itself, [..., 1], override it."""
        return self._surrogates(tensordict, log_weight)

    def _surrogates(self, tensordict: TensorDictBase, log_weight: Tensor) -> dict[str, Tensor]:
        """Per-sample ``loss_objective`` [..., 1] and the `extra_out_keys`."""
        raise NotImplementedError

    def _cost_surrogates(self, tensordict: TensorDictBase, gain: Tensor) -> Tensor:
        """Means over the samples of cost surrogates [..., k], for any reduction: [k]."""
        means = [self._reduce_loss(cost, tensordict, reduction="mean") for cost in gain.unbind(-1)]
        return torch.stack(means)

    def _log_weight(self, tensordict: TensorDictBase, distribution: Distribution) -> Tensor:
        """log(π_θ(a|s) / π_k(a|s)), [..., 1]."""
        keys = self.tensor_keys
        now = distribution.log_prob(require(tensordict, keys.action))
        behaviour = require(tensordict, keys.sample_log_prob, "The collector writes it.")
        if behaviour.shape != now.shape:
            raise ValueError(
                f"{keys.sample_log_prob!r} has shape {tuple(behaviour.shape)}, expected "
                f"{tuple(now.shape)}: one log-probability per action, no trailing dimension."
            )
        if behaviour.requires_grad:
            raise ValueError(
                f"{keys.sample_log_prob!r} has a gradient, which cancels that of the policy: "
                "collect batches under torch.no_grad()."
            )
        return (now - behaviour).unsqueeze(-1)

    def _kl(
        self, tensordict: TensorDictBase, distribution: Distribution, log_weight: Tensor
    ) -> Tensor:
        """KL(π_θ ‖ π_k) per state, [...]."""
        entries = {
            key: require(tensordict, place, self._behaviour_hint)
            for key, place in self.behaviour_keys.items()
        }
        stored = TensorDict(entries)
        behaviour = self.actor_network.build_dist_from_params(stored)
        return kl(distribution, behaviour, log_weight.squeeze(-1))

    def _advantage(self, tensordict: TensorDictBase, log_weight: Tensor) -> Tensor:
        """Reward advantage, [..., 1]."""
        key = self.tensor_keys.advantage
        advantage = require(tensordict, key, "VectorGAE writes it.")
        if advantage.shape != log_weight.shape:
            raise ValueError(
                f"{key!r} has shape {tuple(advantage.shape)}, expected {tuple(log_weight.shape)}."
            )
        return advantage

    def _cost_advantage(self, tensordict: TensorDictBase) -> Tensor:
        """Cost advantages, [..., k]."""
        key = self.tensor_keys.cost_advantage
        hint = "" if self.has_costs else f"{type(self).__name__} needs has_costs = True to get it; "
        advantage = require(tensordict, key, f"{hint}CostGAE writes it.")
        num_costs = advantage.shape[-1] if self.multiplier is None else self.multiplier.num_costs
        # with several agents in a state, each has its own cost advantage and log-probability
        samples = tensordict[self.tensor_keys.sample_log_prob]
        if advantage.shape != (*samples.shape, num_costs):
            raise ValueError(
                f"{key!r} has shape {tuple(advantage.shape)}, expected "
                f"{(*samples.shape, num_costs)}: one column per cost limit."
            )
        return advantage

    def _lagrangian(self, tensordict: TensorDictBase, reward_gain: Tensor, ratio: Tensor) -> Tensor:
        """Objective per sample, [..., 1]: that of the reward alone."""
        if self.multiplier is not None:
            raise TypeError(
                f"{type(self).__name__} has a multiplier, which this class does not use: derive it "
                "from PPOLagrangianLoss, or from safe_rl.objectives.surrogate.WeighsCosts."
            )
        return reward_gain


class WeighsCosts(SurrogateLoss):
    """Mixin for a policy loss without costs: adds costs, weighted by λ / u.

    u is the typical size of one cost (`LimitState.unit`), 1 before `prepare` and after one without
    limits.

    Args:
        actor_network: Policy with `get_dist`; see `SurrogateLoss`.
        multiplier: Multiplier with one λ per column of ``cost_advantage``, read at every call.
        settings: Settings of the loss without costs.

    Raises:
        TypeError: If there is no multiplier.
    """

    multiplier: Multiplier

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        multiplier: Multiplier,
        **settings: Any,
    ) -> None:
        super().__init__(actor_network, **settings)
        if not isinstance(multiplier, Multiplier):
            raise TypeError(
                f"{type(self).__name__} needs a Multiplier, such as a LagrangeMultiplier, got "
                f"{multiplier!r}: without constraints use PPOLoss or TRPOLoss."
            )
        self.multiplier = multiplier

    def prepare(self, batch: TensorDictBase, limits: LimitState | None = None) -> TensorDictBase:
        """Also refuse a state that is not of the multiplier's costs."""
        if limits is not None:
            limits.check(self.multiplier.cost_keys)
        return super().prepare(batch, limits)

    def _cost_advantage(self, tensordict: TensorDictBase) -> Tensor:
        """Cost advantages in units of one cost, A_c / u, [..., k]."""
        advantage = super()._cost_advantage(tensordict)
        return advantage / self._unit(advantage)

    def _cost_gain(self, tensordict: TensorDictBase, ratio: Tensor) -> Tensor:
        """Cost surrogates per sample, [..., k]."""
        return ratio * self._cost_advantage(tensordict)

    def _lagrangian(self, tensordict: TensorDictBase, reward_gain: Tensor, ratio: Tensor) -> Tensor:
        """(L_r − Σᵢ λᵢ L_cᵢ) / (1 + Σᵢ λᵢ) per sample, [..., 1].

        The division keeps the step size of an optimiser independent of λ (Stooke, Achiam and
        Abbeel 2020, section 4.4).
        """
        multipliers = self.multiplier.value
        penalty = (self._cost_gain(tensordict, ratio) * multipliers).sum(-1, keepdim=True)
        return (reward_gain - penalty) / (1 + multipliers.sum())

    def _unit(self, like: Tensor) -> Tensor | float:
        """u, [k], with the dtype and device of a tensor."""
        return 1.0 if self._limits is None else self._limits.unit.to(like)

    def _penalised_advantage(self, tensordict: TensorDictBase, log_weight: Tensor) -> Tensor:
        """A − Σᵢ λᵢ A_cᵢ, the advantage of the reward minus the weighted costs, [..., 1]."""
        weighed = self._cost_advantage(tensordict) * self.multiplier.value
        return self._advantage(tensordict, log_weight) - weighed.sum(-1, keepdim=True)
