"""A risk measure of your own.

`UpperSemideviation` limits E[C] + w E[(C − E[C])₊], the mean cost of an episode plus w times the
mean excess of costly episodes (Ruszczyński and Shapiro 2006). It computes a measured cost of each
step, which replaces its cost where the limit is compared.

The file in `conf/` beside this one names the class:

    python train.py import=examples/custom_risk.py --config-dir examples/conf \
        risk=semideviation env=PointGoal1 frames=60_000

This runs three epochs, to see it work; without `frames` it learns. The column `violation_cost` is
the limited measure minus d.
"""

import torch
from torch import Tensor

from safe_rl.objectives import RiskMeasure
from safe_rl.objectives.risk import MeasuredCosts, cost_so_far


class UpperSemideviation(RiskMeasure):
    """Measured costs of mean E[C] + w E[(C − m)₊], m the running mean of C."""

    state_names = ("_mean",)  # what checkpoints keep of it

    def __init__(self, cost_limits: Tensor, *, weight: float, decay: float) -> None:
        self.limits, self.weight, self.decay = cost_limits, weight, decay
        self._mean = torch.full_like(cost_limits, torch.inf)  # no episode is above it yet

    def __call__(
        self, costs: Tensor, ends: Tensor, before: Tensor, finished: Tensor
    ) -> MeasuredCosts:
        """Compute the measured costs of a batch: see `safe_rl.objectives.RiskMeasure`."""
        if len(finished):
            mean = finished.float().mean(0)
            known = self._mean.isfinite()
            self._mean = torch.where(known, torch.lerp(mean, self._mean, self.decay), mean)
        beyond = (cost_so_far(costs, ends, before) - self._mean).clamp_min(0)
        measured = costs + self.weight * torch.minimum(costs, beyond)
        return MeasuredCosts(measured, offset=torch.zeros_like(self.limits), limit=self.limits)
