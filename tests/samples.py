"""Small batches, actors and critics shared by the objective tests."""

from dataclasses import replace

import torch
from tensordict import TensorDict
from tensordict.nn import NormalParamExtractor, TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.envs.utils import ExplorationType
from torchrl.modules import IndependentNormal, ProbabilisticActor

from safe_rl.objectives import LimitState
from safe_rl.objectives.trust_region import FisherProduct, flatten, set_parameters

NUM_OBS, NUM_ACTIONS = 3, 2
DELTA = 0.01  # radius of trust regions
TRUST_REGION = {
    "target_kl": DELTA, "damping": 0.1, "cg_iterations": 60, "backtrack_coeff": 0.8,
    "max_backtracks": 10,
}  # fmt: skip

LIMITS = {
    "margin": 0.5, "largest_margin": 0.2, "latest_end": 0.7, "smallest_scale": 0.01, "drift": 0.2,
    "decay": 0.9, "lowest_realised_share": 0.1, "integral": 0.0, "largest_integral": 0.5,
}  # fmt: skip
"""Settings of a `LimitTracker` but for those in steps."""


def make_actor(
    in_key="observation", loc="loc", scale="scale", action="action", width=8,
    log_prob="action_log_prob",
):  # fmt: skip
    net = nn.Sequential(
        nn.Linear(NUM_OBS, width),
        nn.Tanh(),
        nn.Linear(width, 2 * NUM_ACTIONS),
        NormalParamExtractor(),
    )
    return ProbabilisticActor(
        TensorDictSequential(TensorDictModule(net, in_keys=[in_key], out_keys=[loc, scale])),
        in_keys={"loc": loc, "scale": scale},
        out_keys=[action],
        distribution_class=IndependentNormal,
        default_interaction_type=ExplorationType.RANDOM,
        return_log_prob=True,
        log_prob_key=log_prob,
    )


def make_critic(out_key="state_value", outputs=1, in_key="observation"):
    return TensorDictModule(nn.Linear(NUM_OBS, outputs), in_keys=[in_key], out_keys=[out_key])


def make_batch(actor, batch_size, num_costs=1):
    """A batch as a training loop hands it to a loss: sampled by `actor`, with advantages."""
    batch = TensorDict(observation=torch.randn(*batch_size, NUM_OBS), batch_size=batch_size)
    with torch.no_grad():
        actor(batch)
    batch["advantage"] = torch.randn(*batch_size, 1)
    if num_costs:
        batch["cost_advantage"] = 3 * torch.randn(*batch_size, num_costs)
    return batch


def limit_state(*violation, length=100.0, unit=None):
    """The state of limits whose violations are these, exactly; every scale is 1."""
    state = LimitState.of(cost=violation, limit=[0.0] * len(violation), length=length)
    return state if unit is None else replace(state, unit=torch.tensor(unit))


def whole_step(step, batch, *given):
    """The step of which a line search takes a fraction, and its metrics; the policy stays."""
    before = flatten(step.parameters).detach().clone()
    metrics = step(batch, *given)
    assert metrics["step_fraction"] > 0
    moved = flatten(step.parameters).detach() - before
    set_parameters(step.parameters, before)
    return moved / metrics["step_fraction"], metrics


def dense_fisher(actor, batch, damping=0.1):
    """The Fisher matrix plus damping, [P, P], in double precision."""
    parameters = list(actor.parameters())
    product = FisherProduct(actor, batch, parameters, damping)
    return torch.stack([product(row) for row in torch.eye(flatten(parameters).numel())]).double()


def flat_gradients(actor, *values):
    """Gradients of scalars by all parameters, [P] each, in double precision."""
    parameters = list(actor.parameters())
    rows = (torch.autograd.grad(value, parameters, retain_graph=True) for value in values)
    return [flatten(row).double() for row in rows]


def perturb(actor, size=0.05):
    """Move an actor away from the policy that sampled the batch."""
    with torch.no_grad():
        for parameter in actor.parameters():
            parameter.add_(size * torch.randn_like(parameter))


def assert_gradients_are_differences(evaluate, actor):
    """The gradient of `evaluate()` by each parameter, in double precision, along some direction."""
    for parameter in list(actor.parameters()):
        direction, values = torch.randn_like(parameter), []
        slope = (torch.autograd.grad(evaluate(), parameter)[0] * direction).sum()
        for size in (1e-6, -2e-6):
            parameter.data += size * direction
            values.append(evaluate().detach())
        parameter.data += 1e-6 * direction
        torch.testing.assert_close(slope, (values[0] - values[1]) / 2e-6, rtol=1e-4, atol=1e-7)


def make_rollout(critics, n=4, steps=37, p_end=0.12, costs=("cost",), done=None):
    """Rollout whose next observation is the following root one, except where it ends."""
    done = torch.rand(n, steps, 1) < p_end if done is None else done
    terminated = done & (torch.rand(n, steps, 1) < 0.5)
    observation = torch.randn(n, steps + 1, NUM_OBS)
    final = torch.randn(n, steps, NUM_OBS)
    following = TensorDict(
        observation=torch.where(done, final, observation[:, 1:]),
        reward=torch.randn(n, steps, 1),
        done=done,
        terminated=terminated,
        batch_size=[n, steps],
    )
    for key in costs:
        following[key] = torch.rand(n, steps, 1)
    rollout = TensorDict(observation=observation[:, :-1], next=following, batch_size=[n, steps])
    with torch.no_grad():
        for critic in critics:
            critic(rollout)
            critic(rollout["next"])
    return rollout
