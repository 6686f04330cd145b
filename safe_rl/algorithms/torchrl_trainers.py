"""Constraints and updates as parts of TorchRL's own `Trainer`.

`examples/torchrl_trainer.py` uses them with TorchRL's `PPOTrainer` and with a `CPOStep`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.trainers import Trainer
from torchrl.trainers.trainers import OptimizationStepper, TrainerHookBase

from safe_rl.algorithms.algorithm_contract import PolicyUpdate, Stateful
from safe_rl.algorithms.constraints import Constraints
from safe_rl.algorithms.minibatch import MinibatchUpdate
from safe_rl.collectors import EpisodeAccounting
from safe_rl.objectives import LimitState, Multiplier, SurrogateLoss
from safe_rl.resumable import Resumable


class ConstraintHook(TrainerHookBase):
    """Updates constraints and multiplier with every collected batch, and tells a loss.

    A trainer calls it before the losses (`register`), and logs its returns, costs, violations and
    multipliers.

    Args:
        constraints: The constraints, without a risk measure.
        accounting: Sums costs and rewards of the collector's batches over episodes.
        multiplier: The multiplier that the loss reads, or None.
        loss: Policy loss that the trainer minimises itself, or None.

    Attributes:
        limits: State of the limits after the last batch, or None.

    Raises:
        TypeError: If the constraints have a risk measure.

    Examples:
        >>> accounting = EpisodeAccounting(num_envs=1, cost_keys=["cost"])
        >>> hook = ConstraintHook(Constraints({"cost": 1.0}), accounting)
        >>> done = torch.tensor([[[False], [True]]])
        >>> step = {"reward": torch.ones(1, 2, 1), "cost": torch.ones(1, 2, 1), "done": done}
        >>> _ = hook(TensorDict({"next": step}, [1, 2]))
        >>> hook.limits.violation
        tensor([1.])
    """

    def __init__(
        self,
        constraints: Constraints,
        accounting: EpisodeAccounting,
        *,
        multiplier: Multiplier | None = None,
        loss: SurrogateLoss | None = None,
    ) -> None:
        if constraints.risk is not None:
            raise TypeError(
                "ConstraintHook takes no risk measure: it replaces costs before advantages are "
                "estimated, which TorchRL's trainers do not see. Use train.py with risk=…."
            )
        self.constraints, self.accounting = constraints, accounting
        self.multiplier, self.loss = multiplier, loss
        self.limits: LimitState | None = None
        self._row: dict[str, float] = {}

    def __call__(self, batch: TensorDictBase) -> TensorDictBase:
        """Update everything from a batch [N, T] or [T], which is not changed."""
        episodes = self.accounting.update(batch)
        self.limits = self.constraints.update(batch, episodes)
        if self.multiplier is not None:
            self.multiplier.update(self.limits)
        if self.loss is not None:
            self.loss.prepare(batch, self.limits)
        self._row = episodes.scalars() | self.constraints.columns(self.limits, self.multiplier)
        return batch

    def log(self, batch: TensorDictBase) -> dict[str, float]:
        """Values to log about the last batch."""
        return self._row

    def state_dict(self) -> dict[str, Any]:
        """Accounting, constraints and multiplier."""
        return {name: part.state_dict() for name, part in self._components().items()}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Continue from :meth:`state_dict`."""
        for name, part in self._components().items():
            part.load_state_dict(state_dict[name])

    def _components(self) -> dict[str, Stateful]:
        parts: dict[str, Stateful] = {
            "accounting": self.accounting,
            "constraints": self.constraints,
        }
        return parts if self.multiplier is None else {**parts, "multiplier": self.multiplier}

    def register(self, trainer: Trainer, name: str = "constraints") -> None:
        """Add the hook to a trainer, for every batch, its log and its checkpoints."""
        trainer.register_op("batch_process", self)
        trainer.register_op("pre_steps_log", self.log)
        trainer.register_module(name, self)


class UpdateStepper(Resumable, OptimizationStepper):
    """A trust-region step, or another `PolicyUpdate`, as a trainer's optimisation step.

    It takes the batch that the trainer passes. Without a replay buffer and with
    ``optim_steps_per_batch=1`` this is the whole collected batch, as a trust-region step needs it.

    Args:
        policy_update: A `TRPOStep`, a `CPOStep` or a `MinibatchUpdate`.
        critic_update: Update that fits the critics afterwards, or None.
        hook: Updates the constraints of a constrained step, or None.

    Examples:
        >>> from safe_rl.algorithms import TRPOStep
        >>> from safe_rl.models import make_actor
        >>> from safe_rl.objectives import TRPOLoss
        >>> actor = make_actor(3, 2, hidden_sizes=[8], initial_log_std=-0.5)
        >>> with torch.no_grad():
        ...     batch = actor(TensorDict(observation=torch.randn(8, 3), batch_size=[8]))
        >>> batch["advantage"] = torch.randn(8, 1)
        >>> search = {"cg_iterations": 10, "backtrack_coeff": 0.8, "max_backtracks": 10}
        >>> loss = TRPOLoss(actor, entropy_coeff=0.0)
        >>> update = TRPOStep(loss, target_kl=0.01, damping=0.1, **search)
        >>> bool(UpdateStepper(update).step(None, batch)["kl"] <= 0.01)
        True
    """

    state_names = ("policy_update", "critic_update")

    def __init__(
        self,
        policy_update: PolicyUpdate,
        critic_update: MinibatchUpdate | None = None,
        hook: ConstraintHook | None = None,
    ) -> None:
        self.policy_update, self.critic_update = policy_update, critic_update
        self.hook = hook

    def step(self, trainer: Trainer | None, sub_batch: TensorDictBase) -> TensorDictBase:
        """Improve policy and critics on a batch with advantages and value targets, of any shape.

        Returns:
            Diagnostics of the updates, as scalars; one per constraint for vectors [k].
        """
        constraints = Constraints({}) if self.hook is None else self.hook.constraints
        rows = [self.policy_update(sub_batch, None if self.hook is None else self.hook.limits)]
        if self.critic_update is not None:
            rows.append({f"critic_{k}": v for k, v in self.critic_update(sub_batch).items()})
        scalars: dict[str, float] = {}
        for row in rows:
            for name, value in row.items():
                scalars |= constraints.column(name, torch.as_tensor(value))
        return TensorDict({name: torch.tensor(value) for name, value in scalars.items()})
