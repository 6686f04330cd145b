"""Base classes of off-policy losses: separate critic and actor losses, evaluated without vmap."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from typing import Any, Literal, Protocol, runtime_checkable

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from tensordict.nn import dispatch
from torch import Tensor
from torch.nn.functional import mse_loss
from torchrl.objectives import LossModule
from torchrl.objectives.value import TD0Estimator, ValueEstimatorBase

from safe_rl.checks import Checked
from safe_rl.objectives.limits import LimitState
from safe_rl.objectives.samples import SharesTensors, require, sample_mask


@runtime_checkable
class Ensemble(Protocol):
    """A network that evaluates several Q functions in one call, such as a `QEnsemble`."""

    num_networks: int  # E
    in_keys: Sequence[NestedKey]  # of what it reads in a state, and last of the action

    def layers(self, params: TensorDictBase) -> Any:
        """Convert parameters to the argument of `values`."""
        ...

    def values(self, entries: Sequence[Tensor], action: Tensor, layers: Any) -> Tensor:
        """Values [E, ..., n] without TensorDicts, whose overhead exceeds the computation.

        `entries` are those of a state that the network reads, in the order of `in_keys`.
        """
        ...


def check_ensemble(network: Any, what: str) -> None:
    """Refuse a network that is not an ensemble of Q functions."""
    if not isinstance(network, Ensemble):
        raise ValueError(
            f"The {what} has to be a safe_rl.models.QEnsemble, or a module with its attributes "
            f"num_networks and in_keys and its methods values and layers, unlike "
            f"{type(network).__name__}."
        )


class ReplayLoss(Checked, SharesTensors):
    """Interface of losses on steps from a replay buffer, for off-policy algorithms."""

    def target_pairs(self) -> list[tuple[Tensor, Tensor]]:
        """Pairs of tensors: of a target network, and of the network that it follows.

        TorchRL's losses call those of the network ``x`` ``target_x``.
        """
        tensors = {**dict(self.named_parameters()), **dict(self.named_buffers())}
        prefix = "target_"
        return [
            (tensor, tensors[name.removeprefix(prefix)])
            for name, tensor in tensors.items()
            if name.startswith(prefix)
        ]

    def critic_losses(self, tensordict: TensorDictBase) -> TensorDict:
        """Losses of the Q functions alone, for gradient steps that do not change the policy."""
        raise NotImplementedError(
            f"{type(self).__name__} has no Q functions: use policy_update.policy_delay=1."
        )

    def prepare(self, batch: TensorDictBase, limits: LimitState) -> None:
        """Learn the scales of costs and rewards: call it with every batch, before its updates.

        The batch has new steps of the current policy, [N, T]; `limits` is the state after it.
        """

    def cost_bias(self, batch: TensorDictBase) -> Tensor | None:
        """Bias of the critics of k costs on new steps [N, T], [k]; None without such critics."""


class QFunctionLoss(ReplayLoss):
    """Mixin for TorchRL's off-policy losses; in a class definition it comes before TorchRL's class.

    Attributes:
        gamma: Discount per step of reward and costs, equal to that of the value estimator.
    """

    gamma: float
    qvalue_network: Ensemble
    _in_keys: list[NestedKey]
    # TorchRL's TD3 replaces this property by a list, with which `select_out_keys` fails
    out_keys = LossModule.out_keys

    def _set_in_keys(self) -> None:
        super()._set_in_keys()
        # TorchRL's losses name only what the actor reads in the next state
        following = [("next", key) for key in self.qvalue_network.in_keys[:-1]]
        self._in_keys = list(dict.fromkeys(map(unravel_key, [*self._in_keys, *following])))

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Evaluate all losses on steps [...]; the TD error is written as their priority.

        Returns:
            TensorDict with `out_keys`, without batch dimension.
        """
        return self.critic_losses(tensordict).update(self.actor_losses(tensordict))

    def _make_vmap(self) -> None:
        """Make no functions by vmap: an ensemble evaluates all of its networks in one call."""

    def critic_losses(self, tensordict: TensorDictBase) -> TensorDict:
        """Losses of the Q functions of rewards."""
        keys = self.tensor_keys
        target = self._td_targets(tensordict)
        action = require(tensordict, keys.action)
        values = self.q_values("qvalue_network", tensordict, action).squeeze(-1)
        errors = mse_loss(values, target.expand_as(values), reduction="none")
        tensordict.set(keys.priority, (values.detach() - target).abs().max(0).values)
        return TensorDict(loss_qvalue=self._mean(errors.sum(0), tensordict))

    @torch.no_grad()
    def _td_targets(self, tensordict: TensorDictBase) -> Tensor:
        """TorchRL's TD targets [...]; TD(0), the default, is computed in half of TorchRL's time."""
        following = self._next_values(tensordict.get("next"))
        reward, terminated = (
            self.column(tensordict, key)
            for key in (self.tensor_keys.reward, self.tensor_keys.terminated)
        )
        estimator = self.value_estimator
        if type(estimator) is not TD0Estimator or estimator.average_rewards:
            steps = tensordict.clone(False).set(("next", estimator.tensor_keys.value), following)
            return estimator.value_estimate(steps).squeeze(-1)
        discount = discount_of(tensordict, self.gamma, estimator.tensor_keys.steps_to_next_obs)
        return (reward + discount * terminated.logical_not() * following).squeeze(-1)

    def _next_values(self, following: TensorDictBase) -> Tensor:
        """Values [..., 1] of the next states, on which the Q functions bootstrap."""
        raise NotImplementedError

    def actor_losses(self, tensordict: TensorDictBase) -> TensorDict:
        """Losses and diagnostics of the policy."""
        raise NotImplementedError

    def penalised(
        self, objective: Tensor, tensordict: TensorDictBase, action: Tensor
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """The actor's loss [...], with a penalty if there are cost critics, and diagnostics."""
        return objective, {}

    def _mean(self, losses: Tensor, tensordict: TensorDictBase) -> Tensor:
        """Mean of losses [...] over the steps, with weights in case of prioritised replay."""
        weights = self._maybe_get_priority_weight(tensordict)
        return self._reduce_loss(losses, tensordict=tensordict, weights=weights)

    def of_samples(self, values: Tensor, tensordict: TensorDictBase, first: int = 1) -> Tensor:
        """Outputs [E, ..., n] of an ensemble for the steps [...] that are not padding.

        `first` is the number of dimensions before those of the steps.
        """
        mask = sample_mask(tensordict, self)
        return values if mask is None else values[(slice(None),) * first + (mask,)]

    def q_values(
        self,
        name: str,
        steps: TensorDictBase,
        action: Tensor,
        kind: Literal["own", "target", "frozen"] = "own",
    ) -> Tensor:
        """Values [E, ..., n] of actions [..., A] in the states of steps [...].

        The ensemble is the attribute `name`. Its parameters are its own, those of the target
        network, or its own without gradients (``"frozen"``).
        """
        network: Ensemble = getattr(self, name)
        params = f"{'target_' if kind == 'target' else ''}{name}_params"

        def arrange() -> Any:
            values = getattr(self, params)
            return network.layers(values.data if kind == "frozen" else values)

        layers = self.cached((name, kind), params, arrange)
        entries = [require(steps, key) for key in network.in_keys[:-1]]
        return network.values(entries, action, layers)

    def cached(self, key: Hashable, params: str, compute: Callable[[], Any]) -> Any:
        """What is computed from the parameters `params`, once for as long as they are there.

        Others take their place in ``with others.to_module(loss)``, if the attribute is set, and if
        a parameter gets other memory.
        """
        # TorchRL clears this cache whenever parameters move to another device or dtype
        cache = self.__dict__.setdefault("_cache", {})
        module = self._modules.get(params)
        source = getattr(module, "_param_td", None)
        known, leaves, places, value = cache.get(key, (None, [], [], None))
        # some optimisers assign `p.data`: views without gradients would keep the old numbers
        if known is None or known is not source or [p.data_ptr() for p in leaves] != places:
            leaves = [] if module is None else list(module.parameters())
            cache[key] = source, leaves, [p.data_ptr() for p in leaves], (value := compute())
        return value

    def column(self, tensordict: TensorDictBase, key: NestedKey) -> Tensor:
        """An entry below ``next`` that holds one number per step, [..., 1]."""
        value = require(tensordict, ("next", key))
        expected = [*require(tensordict, self.tensor_keys.action).shape[:-1], 1]
        if list(value.shape) != expected:
            raise ValueError(
                f"The entry {('next', key)} has the shape {list(value.shape)}, and must have "
                f"{expected}: one number per step, [..., 1]."
            )
        return value

    def make_value_estimator(self, value_type: Any = None, **hyperparams: Any) -> LossModule | None:
        """As in TorchRL; the estimator's ``gamma`` is also used for the cost critics."""
        estimator = super().make_value_estimator(value_type, **hyperparams)
        if isinstance(value_type, ValueEstimatorBase):
            hyperparams = {"gamma": value_type.gamma.item()}
        self.gamma = hyperparams.get("gamma", self.gamma)
        return estimator

    def __getstate__(self) -> dict[str, Any]:
        # a copy must not have the cached parameters, which belong to the original loss
        return {name: x for name, x in self.__dict__.items() if not name.startswith("_cache")}


def discount_of(tensordict: TensorDictBase, gamma: float, spanned: NestedKey) -> Tensor | float:
    """γ; if `spanned` has the number n of steps per transition, [..., 1], γⁿ."""
    steps = tensordict.get(spanned, None)
    return gamma if steps is None else gamma ** steps.reshape(*tensordict.batch_size, 1)
