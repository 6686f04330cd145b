"""Transforms of rewards and terminations: EarlyTermination, Sauté RL and Simmer."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

import torch
from annotated_types import MinLen
from pydantic import FiniteFloat, NonNegativeFloat, PositiveFloat, PositiveInt
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded

from safe_rl.checks import Fraction
from safe_rl.envs.contract import add_columns
from safe_rl.envs.transforms.environment import (
    ConstraintTransform,
    costs_of,
    unbounded_like,
    widen,
)

BUDGET = "budget"
Budgets = Annotated[Mapping[str, PositiveFloat], MinLen(1)]
_ROUNDING = 1e-7  # of a budget: the relative rounding error of costs in single precision is lower


class EarlyTermination(ConstraintTransform):
    """The episode terminates at the step at which its cost so far exceeds the budget.

    There is no reward after that, so an algorithm without constraints learns to keep the budget:
    the early terminated MDP of Sun et al. 2021, "Safe Exploration by Solving Early Terminated MDP".
    In evaluation, episodes continue, as in the paper, so that the cost of the whole episode counts.

    Args:
        budgets: Cost key -> undiscounted cost per episode; an episode of exactly this
            cost continues.
        in_evaluation: Whether episodes of an evaluation terminate, too. Then none costs more than
            the budget plus the cost of one step.

    Examples:
        >>> from torchrl.envs import TransformedEnv
        >>> from safe_rl.envs import SafetyGymEnv
        >>> env = SafetyGymEnv("PointGoal1", num_envs=2, seed=0)
        >>> TransformedEnv(env, EarlyTermination({"cost": 25.0})).rollout(3).shape
        torch.Size([2, 3])
    """

    def __init__(
        self,
        budgets: Annotated[Mapping[str, NonNegativeFloat], MinLen(1)],
        in_evaluation: bool = False,
    ) -> None:
        super().__init__()
        self.in_evaluation = in_evaluation
        self.needed_costs = self._budgets = dict(budgets)

    def highest_cost(self, key: str, highest: float, of_a_step: float) -> float:
        """Return the budget plus the highest cost of a step, where episodes terminate by it."""
        ends = key in self._budgets and (self.in_evaluation or not self.evaluating)
        return min(highest, self._budgets[key] + of_a_step) if ends else highest

    def start(self, done: Tensor) -> dict[str, Tensor]:
        """Return costs of 0."""
        return {"spent": done.new_zeros(*done.shape[:-1], len(self._budgets), dtype=torch.float64)}

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        spent = self._rows["spent"] + costs_of(next_tensordict, self._budgets)
        self._rows = {"spent": spent}
        if self.evaluating and not self.in_evaluation:
            return next_tensordict
        allowed = (1 + _ROUNDING) * spent.new_tensor(list(self._budgets.values()))
        over = (spent > allowed).any(-1, keepdim=True)
        for key in ("done", "terminated"):
            next_tensordict.set(key, next_tensordict.get(key) | over)
        # one cause per end, as in the simulated environments; algorithms read only `terminated`
        next_tensordict.set("truncated", next_tensordict.get("truncated") & ~over)
        return next_tensordict


class Saute(ConstraintTransform):
    """Observe the share of the budget that is left; once it is spent, the reward is constant.

    For each of k costs with a budget d, the share z_t is left after t steps: z_0 = 1 and

        z_{t+1} = (z_t - c_t / d) / γ_s

    (Sootla et al. 2022, "Sauté RL: Almost Surely Safe Reinforcement Learning Using State
    Augmentation", section 3): z_T >= 0 means that the discounted cost of the episode is within d.
    `observation` gets k more columns, the component `budget` (an entry of a dictionary). Where a
    share is 0 or less, `reward` becomes `unsafe_reward`, except in evaluation. The environment's
    own reward is kept in `task_reward`, from which logged returns are computed.

    Args:
        budgets: Cost key -> undiscounted cost per episode, d.
        discount: Discount γ_s of the costs.
        unsafe_reward: Reward of every step once a budget is spent.
        rescale_budgets: Whether d becomes d (1 - γ_s^T) / ((1 - γ_s) T), as in the published code:
            the discounted sum of a cost d that is spread evenly over T = `max_episode_steps` steps.

    Raises:
        ValueError: For a budget that is not positive, or a discount out of range.

    Examples:
        >>> from torchrl.envs import TransformedEnv
        >>> from safe_rl.envs import SafetyGymEnv
        >>> env = SafetyGymEnv("PointGoal1", num_envs=2, seed=0)
        >>> saute = Saute({"cost": 25.0}, discount=0.5, unsafe_reward=-1.0, rescale_budgets=False)
        >>> TransformedEnv(env, saute).rollout(2)["observation"][0, :, -1]
        tensor([1., 2.])
    """

    return_key = "task_reward"

    def __init__(
        self,
        budgets: Budgets,
        *,
        discount: Fraction,
        unsafe_reward: FiniteFloat,
        rescale_budgets: bool,
    ) -> None:
        super().__init__()
        self.needed_costs = self._budgets = dict(budgets)
        self._discount = discount
        self._unsafe_reward = unsafe_reward
        self._rescales = rescale_budgets

    def start(self, done: Tensor) -> dict[str, Tensor]:
        """Return the whole budget."""
        shape = (*done.shape[:-1], len(self._budgets))
        return {BUDGET: done.new_ones(shape, dtype=torch.float64)}

    def extend_layout(self, layout: Mapping[str, slice]) -> dict[str, slice]:
        """Add the component `budget`; ValueError if there is one already."""
        if BUDGET in layout:
            raise ValueError(
                f"The observation has a component '{BUDGET}' already: use one of saute and simmer."
            )
        return add_columns(layout, {BUDGET: len(self._budgets)})

    def _allowed(self, like: Tensor) -> Tensor:
        """Budgets d by which costs are divided, [k]."""
        budgets = like.new_tensor(list(self._budgets.values()))
        if not self._rescales or self._discount == 1:
            return budgets
        steps = self.container.max_episode_steps
        return budgets * (1 - self._discount**steps) / ((1 - self._discount) * steps)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        costs = costs_of(next_tensordict, self._budgets)
        left = (self._rows[BUDGET] - costs / self._allowed(costs)) / self._discount
        self._rows = {**self._rows, BUDGET: left}
        reward = next_tensordict.get("reward")
        # the first transform that changes the reward keeps the environment's own
        task_reward = next_tensordict.get(self.return_key, reward)
        next_tensordict.set(self.return_key, task_reward)
        if not self.evaluating:
            spent = (left <= _ROUNDING).any(-1, keepdim=True)
            next_tensordict.set("reward", reward.masked_fill(spent, self._unsafe_reward))
        return self._call(next_tensordict)

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        budget = self._rows[BUDGET]
        observation = next_tensordict.get("observation")
        if isinstance(observation, Tensor):
            columns = torch.cat([observation, budget.to(observation.dtype)], -1)
            return next_tensordict.set("observation", columns)
        return next_tensordict.set(("observation", BUDGET), budget.float())

    def transform_reward_spec(self, reward_spec: TensorSpec) -> TensorSpec:
        """Add the environment's own reward, and remove the bounds of both rewards."""
        for key in (self.return_key, "reward"):
            reward_spec[key] = unbounded_like(reward_spec["reward"])
        return reward_spec

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Add the columns; ValueError for a picture."""
        observed = observation_spec["observation"]
        if isinstance(observed, Composite):
            shape = (*observation_spec.shape, len(self._budgets))
            observed[BUDGET] = Unbounded(shape=shape, device=observed.device, dtype=torch.float32)
            return observation_spec
        return widen(observation_spec, len(self._budgets), "A budget")


class Simmer(Saute):
    """Sauté RL with budgets that grow during training, from a share of d to all of it.

    An episode starts with z_0 = d_n / d, where d_n is the budget after n steps of its environment
    (Sootla et al. 2022, "Enhancing Safe Exploration Using Safety State Augmentation"). d_n grows
    linearly here; the schedules of the paper depend on the learning progress. Episodes of an
    evaluation start with the whole budget.

    Args:
        budgets: Cost key -> undiscounted cost per episode, d.
        first: Share of d with which training begins.
        steps: Steps of each environment after which the budget is the whole d.
        settings: Other arguments of `Saute`.

    Raises:
        ValueError: For a value out of range.

    Examples:
        >>> from torchrl.envs import TransformedEnv
        >>> from safe_rl.envs import SafetyGymEnv
        >>> env = SafetyGymEnv({"robot_base": "point", "num_steps": 5}, seed=0)
        >>> saute = {"discount": 1.0, "unsafe_reward": -1.0, "rescale_budgets": True}
        >>> env = TransformedEnv(env, Simmer({"cost": 25.0}, first=0.2, steps=10, **saute))
        >>> env.rollout(12, break_when_any_done=False)["observation"][0, ::5, -1]
        tensor([0.2000, 0.6000, 1.0000])
    """

    def __init__(
        self,
        budgets: Budgets,
        *,
        first: Fraction,
        steps: PositiveInt,
        **settings: Any,
    ) -> None:
        super().__init__(budgets, **settings)
        self._first, self._steps = first, steps
        self._steps_before = 0

    def continue_from(self, steps: int) -> None:
        """Continue the schedule after this number of steps per row."""
        self._steps_before = steps
        if "age" in self._rows:
            self._rows["age"] = torch.full_like(self._rows["age"], steps)

    def start(self, done: Tensor) -> dict[str, Tensor]:
        """Return the share of the budget at this step of training, and the step (`age`)."""
        before = torch.full_like(done, self._steps_before, dtype=torch.int64)
        age = self._rows.get("age", before)
        share = self._first + (1 - self._first) * (age / self._steps).clamp(max=1).double()
        whole = super().start(done)[BUDGET]
        return {BUDGET: whole if self.evaluating else whole * share, "age": age}

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        self._rows = {**self._rows, "age": self._rows["age"] + 1}
        return super()._step(tensordict, next_tensordict)
