"""Losses on Q functions of two costs, and steps for them."""

import torch
from samples import limit_state
from tensordict import TensorDict
from torchrl.data import Bounded

from safe_rl.models import QEnsemble, make_bounded_actor, make_squashed_actor
from safe_rl.objectives import (
    CALLoss,
    LagrangeMultiplier,
    SACLagrangianLoss,
    SACLoss,
    TD3LagrangianLoss,
    TD3Loss,
)

BOUNDS = -torch.ones(2), torch.ones(2)
SPEC = Bounded(-1, 1, [2])
COSTS = ["cost", "cost_other"]
SAC = {"gamma": 0.9, "alpha_init": 0.2, "action_spec": SPEC}
CAL = SAC | {"convexity": 10.0, "ratio_memory": 0.9, "largest_ratio": 2.0}
TD3 = {"gamma": 0.9, "policy_noise": 0.2, "noise_clip": 0.5, "action_spec": SPEC}


def make_steps(size=6, terminated=False):
    flags = torch.full((size, 1), terminated)
    following = {
        "observation": torch.randn(size, 3), "reward": torch.randn(size, 1),
        "done": flags, "terminated": flags,
        **{key: torch.rand(size, 1) for key in COSTS},
    }  # fmt: skip
    return TensorDict(
        observation=torch.randn(size, 3), action=torch.rand(size, 2), next=following,
        batch_size=[size],
    )  # fmt: skip


def make_q(networks=2, **keys):
    return QEnsemble(3, 2, hidden_sizes=[8], num_networks=networks, **keys)


def told(loss, unit, rewards=()):
    """The loss, which knows the size of one cost, and these rewards."""
    rewards = torch.as_tensor(rewards).reshape(-1, 1)
    batch = TensorDict({"next": {"reward": rewards}}, rewards.shape[:1])
    loss.prepare(batch, limit_state(*[0.0] * len(unit), unit=unit))
    return loss


def make_loss(kind, multiplier=None, networks=2, *, is_prepared=True, **keys):
    make_own, settings, plain, constrained = {
        "sac": (make_squashed_actor, SAC, SACLoss, SACLagrangianLoss),
        "td3": (make_bounded_actor, TD3, TD3Loss, TD3LagrangianLoss),
        "cal": (make_squashed_actor, CAL, SACLoss, CALLoss),
    }[kind]
    settings, actor = settings | keys, make_own(3, *BOUNDS, hidden_sizes=[8])
    if multiplier is None:
        return plain(actor, make_q(), **settings)
    cost_q = make_q(networks, num_outputs=2, out_key="cost_value")
    loss = constrained(actor, make_q(), cost_q, multiplier=multiplier, cost_keys=COSTS, **settings)
    return told(loss, [1.0, 1.0]) if is_prepared else loss


def lagrange(*values):
    return LagrangeMultiplier(dict(zip(COSTS, (25.0, 10.0), strict=True)), init=values, lr=0.05)
