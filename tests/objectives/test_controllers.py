"""The PI multiplier by hand, and against a simulated policy beside the PID it replaces."""

import pytest
import torch

from safe_rl.objectives.controllers import PIMultiplier
from safe_rl.objectives.pid import PIDMultiplier

GAINS = {"init": 0.0, "kp": 2.0, "ki": 0.2, "saturation": 1.0, "highest": 5.0}
# what lagrangian=pid says
PID = {
    "init": 0.0, "kp": 0.25, "ki": 0.05, "kd": 0.0, "proportional_ema": 0.5,
    "derivative_ema": 0.5, "derivative_delay": 10, "scale": "limit",
}  # fmt: skip


def follow(multiplier, epochs=300, noise=5.0, seed=0):
    """J_c of a policy that λ controls as experiments have it, [epochs].

    Per update J_c moves by a quarter of (λ* − λ) limits, at most by a fifth of one; the λ* that
    keeps it where it is rises from 0.9 to 1.4 over the first hundred; the controller sees noise.
    """
    generator = torch.Generator().manual_seed(seed)
    cost, costs, limit = torch.tensor([60.0]), [], multiplier.limits
    for epoch in range(epochs):
        multiplier.update(cost + noise * torch.randn(1, generator=generator))
        balance = 0.9 + 0.5 * min(epoch / 100, 1.0)
        cost = cost + limit * (0.25 * (balance - multiplier.value)).clamp(-0.2, 0.2)
        cost = cost.clamp_min(0)
        costs.append(cost)
    return torch.cat(costs)


def test_two_updates_by_hand():
    multiplier = PIMultiplier(10.0, **GAINS)
    multiplier.update(15.0)
    assert multiplier.value.item() == pytest.approx(1.0 + 0.1)
    # a cost of six times the limit counts as one of twice
    multiplier.update(60.0)
    assert multiplier.value.item() == pytest.approx(2.0 + 0.3)
    # and one of nothing as half of the limit, where that is the saturation
    multiplier = PIMultiplier(10.0, **(GAINS | {"init": 4.0, "saturation": 0.5}))
    multiplier.update(0.0)
    assert multiplier.value.item() == pytest.approx(4.0 - 0.1 - 1.0)


def test_it_follows_a_ramp_where_the_pid_swings_about():
    seeds = range(8)
    ours = torch.stack([follow(PIMultiplier(25.0, **GAINS), seed=seed) for seed in seeds])
    pid = torch.stack([follow(PIDMultiplier(25.0, **PID), seed=seed) for seed in seeds])
    ramp, settled = slice(20, 100), slice(150, 300)
    assert (ours[:, ramp] - 25).abs().mean() < 0.6 * (pid[:, ramp] - 25).abs().mean()
    assert ours[:, settled].mean() == pytest.approx(25, abs=0.5)


def test_it_is_well_damped():
    costs = follow(PIMultiplier(25.0, **GAINS), noise=0.0)
    assert costs.min() > 0.5 * 25
    assert (costs[60:] - 25).abs().max() < 0.2 * 25


def test_the_integral_is_not_wound_up_beyond_what_it_can_put_out():
    multiplier = PIMultiplier(25.0, **GAINS)
    for _ in range(200):
        multiplier.update(100.0)
    assert multiplier.value == 5.0
    for _ in range(6):
        multiplier.update(0.0)
    assert multiplier.value == pytest.approx(5.0 - 6 * 0.2 - 2.0)


def test_ten_times_the_cost_and_the_limit_give_the_same_multiplier():
    small, large = PIMultiplier(25.0, **GAINS), PIMultiplier(250.0, **GAINS)
    for cost in (60.0, 31.0, 12.0, 44.0):
        small.update(cost)
        large.update(10 * cost)
        torch.testing.assert_close(small.value, large.value)


def test_a_limit_of_0_takes_its_unit_from_outside():
    multiplier = PIMultiplier([0.0, 25.0], **GAINS)
    multiplier.set_scale(torch.tensor([10.0, 25.0]))
    multiplier.update([5.0, 37.5])
    assert multiplier.value.tolist() == pytest.approx([1.1, 1.1])


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"kp": -1.0}, "kp and ki"),
        ({"saturation": 0.0}, "saturation"),
        ({"highest": -1.0}, "highest"),
        ({"init": 6.0}, "init must lie"),
    ],
)
def test_settings_out_of_range(settings, message):
    with pytest.raises(ValueError, match=message):
        PIMultiplier(25.0, **(GAINS | settings))
