"""A constrained loss and a risk measure of your own.

- `QuadraticPenaltyLoss` is PPO's loss plus a penalty: the square of the amount by which the
  predicted J_c exceeds its target. `self.limits` is the state of the limits after the last batch.
- `UpperSemideviation` limits E[C] + w E[(C − E[C])₊], the mean cost of an episode plus w times the
  mean excess of costly episodes (Ruszczyński and Shapiro 2006). It computes a measured
  cost of each step, which replaces its cost where the limit is compared.

The files in `conf/` beside this one name these classes:

    python train.py import=examples/custom_loss.py --config-dir examples/conf \
        algo=quadratic risk=semideviation env=PointGoal1 frames=60_000

This runs three epochs, to see it work; without `frames` it learns. Both classes can be combined
with the package's own: `algo=cpo risk=semideviation`, `algo=quadratic risk=cvar`. The column
`violation_cost` is the limited measure minus d.
"""

import torch
from tensordict import TensorDictBase
from torch import Tensor

from safe_rl.objectives import PPOLoss, RiskMeasure
from safe_rl.objectives.risk import MeasuredCosts, cost_so_far


class QuadraticPenaltyLoss(PPOLoss):
    """PPO's loss + kappa · Σᵢ (E[ρAᵢ] + (J_cᵢ − dᵢ) / T̄)₊²."""

    extra_out_keys = ("loss_penalty", "clip_fraction")
    has_costs = True

    def __init__(self, actor_network, *, kappa: float, **settings) -> None:
        super().__init__(actor_network, **settings)
        self.kappa = kappa

    def _surrogates(self, tensordict: TensorDictBase, log_weight: Tensor) -> dict[str, Tensor]:
        gain = log_weight.exp() * self._cost_advantage(tensordict)
        surrogates = self._cost_surrogates(tensordict, gain)  # [k]
        excess = self.limits.excess(surrogates)  # predicted, above the target, per time step
        penalty = self.kappa * excess.relu().square().sum()
        return super()._surrogates(tensordict, log_weight) | {"loss_penalty": penalty}


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
