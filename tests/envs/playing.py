"""Runs of environments that are simulated here, to be compared."""

import torch
from tensordict import TensorDict


def play(env, start: TensorDict, num_steps: int) -> TensorDict:
    """All outputs of a run with resets [N, T]; row k gets the same actions whatever N is."""
    num_envs, size = env.action_spec.shape
    rows = [
        2 * torch.rand(num_steps, size, generator=torch.Generator().manual_seed(row)) - 1
        for row in range(num_envs)
    ]
    steps, tensordict = [], start
    for action in torch.stack(rows, 1) * env.action_spec.space.high[0]:
        following, tensordict = env.step_and_maybe_reset(tensordict.set("action", action))
        steps.append(following["next"].clone())
    return torch.stack(steps, 1)


def assert_same(a: TensorDict, b: TensorDict) -> None:
    assert set(a.keys(True, True)) == set(b.keys(True, True))
    for key, value in a.items(True, True):
        assert torch.equal(value, b[key]), key
