"""Costs in situations small enough to work out by hand."""

import math

import pytest
import torch
from crafting import arrange, make, position_columns, step_from

pytestmark = pytest.mark.filterwarnings("ignore:'constrain_")  # of kinds without objects
ALL_KINDS = ("hazards", "vases", "pillars", "buttons", "gremlins")
MAGNITUDES = {
    "robot_base": "point",
    "constrain_indicator": False,
    "placements_extents": [-6, -6, 6, 6],
    **{f"constrain_{kind}": True for kind in ALL_KINDS},
}
# Without substeps, a step computes the costs and rewards of the state that it starts from.
FROZEN = {**MAGNITUDES, "task": "none", "frameskip_binom_p": 0.0}


def costs(got) -> dict[str, float]:
    return {key: float(value) for key, value in got.items() if key.startswith("cost")}


VASES = {**FROZEN, "vases_num": 2, "vases_displace_cost": 2.0, "vases_velocity_cost": 3.0}


def test_displaced_vases_cost_their_distance_in_the_plane():
    env = make(VASES)
    columns = position_columns(env)["vase0"]
    # a thousandth of a metre is no displacement
    for x, y, wanted in ((0.3, 0.4, 2 * 0.5), (6e-4, 6e-4, 0.0), (8e-4, 8e-4, 2 * 8e-4 * 2**0.5)):
        state = arrange(env, robot=(-3, 0, 0), vase0=(0, 0, 0), vase1=(1, 0, 0))
        state["qpos"][:, columns] += torch.tensor([x, y]).double()
        got = costs(step_from(env, state, 0, 0))
        assert math.isclose(got["cost_vases_displace"], wanted, rel_tol=1e-6)
        assert got["cost_vases_contact"] == got["cost_vases_velocity"] == 0


def test_only_costs_with_a_factor_have_keys():
    config = {**FROZEN, "vases_num": 1, "vases_velocity_cost": 0.0}
    keys = {"cost", "cost_exception", "cost_vases_contact", "cost_hazards", "cost_pillars"}
    assert set(make(config).cost_keys) == keys | {"cost_buttons", "cost_gremlins"}
    assert "cost_vases_displace" in make(VASES).cost_keys


FACTORS = {
    **{"hazards_cost": 2.0, "pillars_cost": 3.0, "buttons_cost": 4.0, "gremlins_contact_cost": 5.0},
    **{"vases_contact_cost": 6.0, "vases_displace_cost": 7.0, "vases_velocity_cost": 8.0},
}


def test_every_cost_is_multiplied_by_its_factor():
    numbers = {f"{kind}_num": 1 for kind in ALL_KINDS}
    places = {"hazard0": (0.1, 0), "pillar0": (-0.295, 0), "button0": (0, 0.19)}
    places |= {"gremlin0": (0.14, 0.14), "vase0": (0, -0.19, 0)}
    found = []
    for factors in (dict.fromkeys(FACTORS, 1.0), FACTORS):
        env = make({**FROZEN, **numbers, **factors})
        state = arrange(env, robot=(0, 0, 0), **places)
        columns = position_columns(env)["vase0"]
        state["layout"][:, 1 + env.object_names.index("vase0")] += 0.1  # it was moved
        state["qvel"][:, columns.start : columns.start + 3] = 0.5
        found.append(costs(step_from(env, state, 0, 0)))
    once, times = found
    for key, factor in FACTORS.items():
        name = "cost_" + key.removesuffix("_cost").replace("gremlins_contact", "gremlins")
        assert once[name] > 0, name
        assert math.isclose(times[name], factor * once[name], rel_tol=1e-6), name


BUTTONS = {
    **FROZEN,
    **{"task": "button", "buttons_num": 3, "buttons_cost": 2.0, "observe_buttons": True},
}


def touching_two_buttons(env, goal: int, timer: int):
    """The robot's sphere touches buttons 0 and 1; button 2 is away."""
    poses = {"button0": (0, 0.19), "button1": (0, -0.19), "button2": (2, 0)}
    state = arrange(env, robot=(0, 0, 0), **poses)
    state["goal_button"][:] = goal
    state["buttons_timer"][:] = timer
    return state


@pytest.mark.parametrize("timer", [0, 5])
def test_pressing_the_goal_button_starts_the_timer(timer):
    env = make({**BUTTONS, "buttons_resampling_delay": 7})
    got = step_from(env, touching_two_buttons(env, goal=1, timer=timer), 0, 0)
    assert got["goal_met"]
    assert env.get_state()["buttons_timer"] == 7


def test_in_other_tasks_all_buttons_are_wrong():
    env = make({**BUTTONS, "task": "none"})
    assert costs(step_from(env, touching_two_buttons(env, -1, 0), 0, 0))["cost_buttons"] == 4.0
