"""The PID multiplier against algorithm 2 of Stooke, Achiam and Abbeel, worked out by hand."""

import pytest
import torch

from safe_rl.objectives.pid import PIDMultiplier

PLAIN = {
    "init": 0.0, "kp": 0.0, "ki": 0.0, "kd": 0.0,
    "proportional_ema": 0.0, "derivative_ema": 0.0, "derivative_delay": 1, "scale": 1.0,
}  # fmt: skip


def run(costs, limits=10.0, **settings):
    multiplier = PIDMultiplier(limits, **(PLAIN | settings))
    values = []
    for cost in costs:
        multiplier.update(cost)
        values.append(multiplier.value.squeeze().tolist())
    return values


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"kp": 0.1}, [0.4, 0.0, 0.2]),
        # The integral is clamped at 0, so that it answers at once when the cost returns.
        ({"ki": 0.1}, [0.4, 0.0, 0.2]),
        ({"ki": 0.1, "init": 1.0}, [1.4, 0.4, 0.6]),
        # Growth from 0 to 14, none from 14 to 0, from 0 to 12.
        ({"kd": 0.1}, [1.4, 0.0, 1.2]),
        # Growth over two updates: since before the first one, since then, from 14 to 12.
        ({"kd": 0.1, "derivative_delay": 2}, [1.4, 0.0, 0.0]),
        ({"kp": 0.1, "ki": 0.01, "kd": 0.1}, [0.4 + 0.04 + 1.4, 0.0, 0.2 + 0.02 + 1.2]),
        # Smoothed errors: 2, then 1 − 5 = −4, then −2 + 1 = −1.
        ({"kp": 0.1, "proportional_ema": 0.5}, [0.2, 0.0, 0.0]),
        # Smoothed costs: 7, 3.5, 7.75.
        ({"kd": 0.1, "derivative_ema": 0.5}, [0.7, 0.0, 0.425]),
        ({"kp": 0.1, "scale": "limit"}, [0.04, 0.0, 0.02]),
        ({"kp": 0.1, "scale": 2.0}, [0.2, 0.0, 0.1]),
    ],
)
def test_three_updates_by_hand(settings, expected):
    assert run([14.0, 0.0, 12.0], **settings) == pytest.approx(expected, abs=1e-6)


def test_costs_are_controlled_separately():
    both = run([[14.0, 1.0], [11.0, 9.0]], limits=[10.0, 4.0], kp=0.1, ki=0.05, kd=0.02)
    first = run([14.0, 11.0], limits=10.0, kp=0.1, ki=0.05, kd=0.02)
    second = run([1.0, 9.0], limits=4.0, kp=0.1, ki=0.05, kd=0.02)
    torch.testing.assert_close(torch.tensor(both).T, torch.tensor([first, second]))


def test_integral_control_settles_where_the_plant_meets_the_limit():
    # A plant whose cost falls with λ: J_c = 30 − 10 λ meets the limit 10 at λ = 2.
    multiplier = PIDMultiplier(10.0, **(PLAIN | {"kp": 0.02, "ki": 0.02}))
    for _ in range(200):
        multiplier.update(30 - 10 * multiplier.value)
    torch.testing.assert_close(multiplier.value, torch.tensor([2.0]), atol=1e-3, rtol=0)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"kp": -1.0}, "Gains"),
        ({"proportional_ema": 1.0}, r"\[0, 1\)"),
        ({"derivative_delay": 0}, "at least 1"),
        ({"init": -1.0}, "init must not be negative"),
        ({"limits": 0.0, "scale": "limit"}, "limit of 0"),
    ],
)
def test_errors_say_what_to_change(settings, message):
    with pytest.raises(ValueError, match=message):
        run([], **settings)
