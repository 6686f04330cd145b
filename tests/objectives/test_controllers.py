"""PI and PID multipliers by hand, PID by Stooke et al. (algorithm 2)."""

import re
from dataclasses import replace

import pytest
import torch
from commands import ROOT
from run_configs import compose_config

from safe_rl.objectives import LimitState
from safe_rl.objectives.multipliers import PIDMultiplier, PIMultiplier

GAINS = {"init": 0.0, "kp": 2.0, "ki": 0.2, "saturation": 1.0, "highest": 5.0}


@pytest.mark.parametrize(
    ("settings", "costs", "expected"),
    [
        ({}, [15.0], 1.0 + 0.1),
        # A cost of six times the limit counts as one of twice.
        ({}, [15.0, 60.0], 2.0 + 0.3),
        # And one of nothing as half of the limit, where that is the saturation.
        ({"init": 4.0, "saturation": 0.5}, [0.0], 4.0 - 0.1 - 1.0),
        # The integral is not wound up beyond what it can put out.
        ({"init": 9.0}, [], 5.0),
        ({}, [40.0] * 200, 5.0),
        ({}, [40.0] * 200 + [0.0] * 6, 5.0 - 6 * 0.2 - 2.0),
    ],
)
def test_updates_of_a_pi_by_hand(settings, costs, expected):
    multiplier = PIMultiplier(10.0, **(GAINS | settings))
    for cost in costs:
        multiplier.update(LimitState.of(cost=[cost], limit=[10.0]))
    assert multiplier.value.item() == pytest.approx(expected)


def test_a_limit_of_0_takes_its_unit_from_the_state():
    multiplier = PIMultiplier([0.0, 25.0], **GAINS)
    measured = LimitState.of(cost=[5.0, 37.5], limit=[0.0, 25.0])
    multiplier.update(replace(measured, scale=torch.tensor([10.0, 25.0])))
    assert multiplier.value.tolist() == pytest.approx([1.1, 1.1])


PLAIN = {
    "init": 0.0, "kp": 0.0, "ki": 0.0, "kd": 0.0,
    "proportional_ema": 0.0, "derivative_ema": 0.0, "derivative_delay": 1, "scale": 1.0,
}  # fmt: skip


def run(costs, limits=10.0, **settings):
    multiplier = PIDMultiplier(limits, **(PLAIN | settings))
    values = []
    for cost in costs:
        cost = torch.as_tensor(cost).reshape(multiplier.num_costs)
        multiplier.update(LimitState.of(cost=cost, limit=multiplier.limits))
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
def test_three_updates_of_a_pid_by_hand(settings, expected):
    assert run([14.0, 0.0, 12.0], **settings) == pytest.approx(expected, abs=1e-6)


def test_costs_are_controlled_separately():
    both = run([[14.0, 1.0], [11.0, 9.0]], limits=[10.0, 4.0], kp=0.1, ki=0.05, kd=0.02)
    first = run([14.0, 11.0], limits=10.0, kp=0.1, ki=0.05, kd=0.02)
    second = run([1.0, 9.0], limits=4.0, kp=0.1, ki=0.05, kd=0.02)
    torch.testing.assert_close(torch.tensor(both).T, torch.tensor([first, second]))


def test_the_controller_of_fsrl_is_translated():
    """The page's words give the multiplier of `LagrangianOptimizer` (fsrl/utils/optim_util.py)."""
    page = (ROOT / "docs/coming_from/fsrl.md").read_text()
    words = re.search(r"`--lagrangian_pid '\[0\.05,0\.0005,0\.1\]'` \| `(.*?)`", page)[1].split()
    settings = {k: v for k, v in compose_config(*words).lagrangian.items() if k != "_target_"}
    costs, expected, old, integral = [30.0, 60.0, 20.0, 45.0], [], 0.0, 0.0
    for error in (cost - 25.0 for cost in costs):
        integral = max(0.0, integral + error)
        rise, old = max(0.0, error - old), error
        expected.append(max(0.0, 0.05 * error + 0.0005 * integral + 0.1 * rise))
    # the first rise is that from an error of 0 there, and from a cost of 0 here
    assert run(costs, 25.0, **settings)[1:] == pytest.approx(expected[1:], abs=1e-6)
