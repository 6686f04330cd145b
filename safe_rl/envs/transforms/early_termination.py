"""Episodes that end when the budget is exceeded."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import torch
from tensordict import TensorDictBase
from torch import Tensor

from safe_rl.envs.transforms.base import ConstraintTransform, check_budgets, check_known, costs_of


class EarlyTermination(ConstraintTransform):
    """The episode terminates with the step at which it has cost more than it may.

    So no reward is to be had beyond the budget, and an algorithm without constraints keeps it: the
    early terminated MDP of Sun et al. 2021, "Safe Exploration by Solving Early Terminated MDP".
    How much is left is not observed; with `saute` before it, it is. Episodes of an
    evaluation go on, as in the paper: there the cost of the whole episode counts. With
    `in_evaluation` they end, too: then what is evaluated is the policy with its switch, which
    surely costs no more than the budget and the last step.

    Args:
        budgets: cost key -> undiscounted cost per episode; an episode that costs exactly this much
            goes on.
        in_evaluation: whether episodes of an evaluation end in the same way.

    Raises:
        ValueError: for a budget below 0.

    Examples:
        >>> from torchrl.envs import TransformedEnv
        >>> from safe_rl.envs import SafetyGymEnv
        >>> env = SafetyGymEnv("PointGoal1", num_envs=2, seed=0)
        >>> TransformedEnv(env, EarlyTermination({"cost": 25.0})).rollout(3).shape
        torch.Size([2, 3])
    """

    def __init__(self, budgets: Mapping[str, float], in_evaluation: bool = False) -> None:
        super().__init__()
        self.in_evaluation = in_evaluation
        self._budgets = check_budgets(budgets, above_zero=False)

    def check(self, cost_keys: Collection[str]) -> None:
        """Raise ValueError if a budget's cost is not among these."""
        check_known(self._budgets, cost_keys)

    def start(self, done: Tensor) -> dict[str, Tensor]:
        """Return that nothing is spent."""
        shape = (*done.shape[:-1], len(self._budgets))
        return {"spent": torch.zeros(shape, dtype=torch.float64, device=done.device)}

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        spent = self._rows["spent"] + costs_of(next_tensordict, self._budgets)
        self._rows = {"spent": spent}
        if self.evaluating and not self.in_evaluation:
            return next_tensordict
        over = (spent > spent.new_tensor(list(self._budgets.values()))).any(-1, keepdim=True)
        for key in ("done", "terminated"):
            next_tensordict.set(key, next_tensordict.get(key) | over)
        # an end that is both would be bootstrapped from by some and not by others
        next_tensordict.set("truncated", next_tensordict.get("truncated") & ~over)
        return next_tensordict
