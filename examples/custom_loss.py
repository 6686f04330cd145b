"""A constrained loss of your own: PPO that limits its worst episodes instead of the mean one.

The limit d applies to the conditional value at risk of the episode cost C: the mean cost of the
worst fraction α of the episodes, CVaR = ν + E[(C − ν)₊] / α with ν, the value at risk, the cost
that a fraction α of the episodes exceeds (Rockafellar and Uryasev 2000, theorem 1). Three parts
take the place of the package's own; the files in `conf/` beside this one name them:

- `conditional_value_at_risk` is what the multiplier compares with d, in place of the mean cost;
- `TailCostGAE` estimates its gradient. It charges a step only for cost beyond ν, divided by α.
  Over an episode this sums to (C − ν)₊ / α, so that the advantages of this cost are those of CVaR;
  how ν moves with the policy is of second order, as ν minimises the expression above (Chow,
  Ghavamzadeh, Janson and Pavone 2017, sections 3 and 5);
- `CVaRPPOLoss` is the Lagrangian (L_r − λ L_c) / (1 + λ) with L_c = E[max(ρA, clip(ρ)A)]: few
  steps carry the tail's cost, and the clip ends what each of them can promise, as it does for the
  reward (Zhang et al. 2022, equation 12).

    python train.py import=examples/custom_loss.py --config-dir examples/conf \
        algo=cvar_ppo env=PointGoal1 num_envs=20 frames=60_000

Three epochs, to see it run; without `frames` it learns. The column `violation_cost` is CVaR − d.
The first two parts go with other algorithms as they are: `algo=cpo +risk=cvar num_envs=20`.
Batches have to hold whole episodes, hence `num_envs=20`: one that a batch cuts counts in parts.
"""

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor

from safe_rl.objectives import CostGAE, PPOLagrangianLoss
from safe_rl.objectives.ppo import clipped_gain
from safe_rl.objectives.surrogate import lagrangian


def value_at_risk(costs: Tensor, tail: float) -> Tensor:
    """The cost that at most a fraction `tail` of the episodes exceeds: [E, k] -> [k]."""
    ranked = costs.sort(0, descending=True).values
    return ranked[min(int(tail * len(ranked)), len(ranked) - 1)]


def conditional_value_at_risk(costs: Tensor, tail: float) -> Tensor:
    """The mean cost of the worst fraction `tail` of the episodes: [E, k] -> [k]."""
    threshold = value_at_risk(costs, tail)
    return threshold + (costs - threshold).clamp_min(0).mean(0) / tail


def cost_so_far(cost: Tensor, ends: Tensor) -> Tensor:
    """Cost of the episode up to and with each step, from cost [N, T, k] ≥ 0 and ends [N, T, 1]."""
    total = cost.cumsum(1)
    before = torch.where(ends, total, 0).roll(1, 1)
    before[:, 0] = 0
    return total - before.cummax(1).values


class TailCostGAE(CostGAE):
    """`CostGAE` of the cost that a step adds to its episode beyond the value at risk."""

    def __init__(self, cost_keys: Sequence[str], value_network, *, tail: float, **settings):
        super().__init__(["tail_cost"], value_network, **settings)
        self.cost_keys, self.tail = list(cost_keys), tail

    def forward(self, rollout: TensorDictBase) -> TensorDictBase:
        """Write ``("next", "tail_cost")``, [N, T, k], then what `CostGAE` writes."""
        cost = torch.cat([rollout["next", key] for key in self.cost_keys], -1)
        ends = rollout["next", "done"].clone()
        ends[:, -1] = True
        spent = cost_so_far(cost, ends)
        beyond = (spent - value_at_risk(spent[ends.squeeze(-1)], self.tail)).clamp_min(0)
        rollout["next", "tail_cost"] = torch.minimum(cost, beyond) / self.tail
        return super().forward(rollout)


class CVaRPPOLoss(PPOLagrangianLoss):
    """`PPOLagrangianLoss` whose cost surrogate is clipped too, to its pessimistic side."""

    def _lagrangian(self, tensordict: TensorDictBase, reward_gain: Tensor, ratio: Tensor) -> Tensor:
        tail_advantage = self._cost_advantage(tensordict)
        cost_gain = -clipped_gain(ratio.log(), -tail_advantage, self.clip_epsilon)
        return lagrangian(reward_gain, cost_gain, self.multiplier.value)
