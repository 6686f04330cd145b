"""Multipliers against hand-computed numbers and against torch's own Adam."""

import math
from dataclasses import replace
from functools import partial

import pytest
import torch
from samples import limit_state

from safe_rl.objectives import Multiplier, PIDMultiplier, PIMultiplier, ProjectedMultiplier
from safe_rl.objectives.multipliers import LagrangeMultiplier, parse_cost_limits


def lagrange(limits=None, init=1.0, lr=0.05):
    return LagrangeMultiplier({"cost": 25.0} if limits is None else limits, init=init, lr=lr)


@pytest.mark.parametrize("init", [1e-4, 1.0, 50.0, 200.0])
def test_initial_value_is_init(init):
    torch.testing.assert_close(lagrange(init=init).value, torch.tensor([init]))


def test_matches_torch_adam_on_the_dual_loss():
    multiplier = lagrange({"a": 25.0, ("nested", "b"): 5.0}, init=[1.0, 0.2], lr=0.03)
    nu = multiplier.nu.clone().requires_grad_()
    adam = torch.optim.Adam([nu], lr=0.03)
    generator = torch.Generator().manual_seed(0)
    for _ in range(50):
        violation = 40 * torch.rand(2, generator=generator) - torch.tensor([25.0, 5.0])
        adam.zero_grad()
        (-nu * violation).sum().backward()
        adam.step()
        multiplier.update(limit_state(*violation.tolist()))
    torch.testing.assert_close(multiplier.nu, nu.detach())


PID = {"kp": 0.1, "ki": 0.1, "kd": 0.1, "proportional_ema": 0.9, "derivative_ema": 0.8}
KINDS = {
    "lagrange": lagrange,
    "pid": partial(PIDMultiplier, init=0.0, derivative_delay=3, scale="limit", **PID),
    "pi": partial(PIMultiplier, init=0.0, kp=2.0, ki=0.2, saturation=1.0, highest=5.0),
    "projected": partial(ProjectedMultiplier, init=0.0, lr=0.01, highest=2.0),
}


@pytest.mark.parametrize("kind", KINDS)
def test_nan_leaves_everything_unchanged_and_resume_is_exact(kind):
    multiplier, resumed = (KINDS[kind]([limit, 5.0]) for limit in (10.0, 1.0))
    for violation in ([4.0, 2.0], [23.0, 8.0]):
        multiplier.update(limit_state(*violation))
    before = {name: buffer.clone() for name, buffer in multiplier.state_dict().items()}
    multiplier.update(limit_state(math.nan, math.nan))
    multiplier.update(replace(limit_state(5.0, 5.0), is_new=False))
    for name, buffer in multiplier.state_dict().items():
        assert torch.equal(buffer, before[name])
    resumed.load_state_dict(before)
    for each in (multiplier, resumed):
        each.update(limit_state(10.0, 8.0))
    assert torch.equal(multiplier.value, resumed.value)
    assert multiplier.value[0] > 0


def test_moves_and_has_nothing_to_train():
    multiplier = lagrange().to("meta")
    assert multiplier.value.device.type == "meta"
    assert not list(multiplier.parameters())
    assert not multiplier.value.requires_grad
    multiplier = lagrange().double()
    multiplier.update(limit_state(10.0))  # float32, as `Constraints.update` returns it
    assert multiplier.value.dtype == torch.float64


def test_limits_without_names_are_numbered_if_there_are_several():
    assert parse_cost_limits(25.0)[0] == parse_cost_limits([25.0])[0] == ["cost"]
    assert parse_cost_limits([25.0, 3.0])[0] == ["cost_0", "cost_1"]


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: lagrange({}), "multiplier=None"),
        (lambda: lagrange([math.inf]), "finite"),
        (lambda: lagrange([-1.0]), "greater than or equal to 0"),
        (lambda: lagrange(init=0.0), "greater than 0"),
        (lambda: lagrange([1.0, 2.0], init=[1.0, 1.0, 1.0]), "2 numbers"),
        (lambda: KINDS["pid"](0.0), "limit of 0"),
    ],
)
def test_errors_say_what_to_change(build, message):
    with pytest.raises(ValueError, match=message):
        build()


def test_a_multiplier_that_would_reward_costs_is_refused():
    class Falling(Multiplier):
        def __init__(self, cost_limits):
            super().__init__(cost_limits)
            self.register_buffer("penalty", torch.zeros(1))

        def _step(self, state):
            return {"penalty": self.penalty + 0.1 * state.violation}

    multiplier = Falling({"cost": 25.0})
    multiplier.update(limit_state(5.0))
    with pytest.raises(ValueError, match=r"Falling: λ must not be below 0, .* got \[-0\.5"):
        multiplier.update(limit_state(-10.0))
