"""Costs in situations small enough to work out by hand, and positions against costs."""

import math

import pytest
import torch
from crafting import arrange, make, position_columns, step_from

from safe_rl.envs import SafetyGymEnv, resolve

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


def positive(got) -> set[str]:
    return {key for key, value in costs(got).items() if value > 0} - {"cost"}


VASES = {**FROZEN, "vases_num": 2, "vases_displace_cost": 2.0, "vases_velocity_cost": 3.0}


def moved_vase(env, *offset: float):
    """Two vases at rest; the first was moved since the reset."""
    state = arrange(env, robot=(-3, 0, 0), vase0=(0, 0, 0), vase1=(1, 0, 0))
    first = position_columns(env)["vase0"]
    state["qpos"][:, first] += torch.tensor(offset, dtype=torch.float64)
    return state


def test_displaced_vases_cost_their_distance_in_the_plane():
    env = make(VASES)
    got = costs(step_from(env, moved_vase(env, 0.3, 0.4), 0, 0))
    assert math.isclose(got["cost_vases_displace"], 2 * 0.5, rel_tol=1e-6)
    assert got["cost_vases_contact"] == got["cost_vases_velocity"] == 0
    below = step_from(env, moved_vase(env, 6e-4, 6e-4), 0, 0)
    assert not positive(below)
    above = step_from(env, moved_vase(env, 8e-4, 8e-4), 0, 0)
    assert math.isclose(costs(above)["cost_vases_displace"], 2 * 8e-4 * math.sqrt(2), rel_tol=1e-4)


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


def test_costs_and_rewards_follow_from_positions():
    config = resolve("CarGoal2").replace(hazards_size=0.9, goal_size=0.01)
    env = SafetyGymEnv(config, num_envs=8, seed=0)
    tensordict, seen = env.reset(), 0
    for _ in range(30):
        before = env.get_positions()
        tensordict = env.rand_action(tensordict)
        following = env.step(tensordict)["next"]
        now = env.get_positions()
        to_hazards = (now["hazards"] - now["robot"])[..., :2].norm(dim=-1)
        inside = (to_hazards <= 0.9).any(-1, keepdim=True)
        assert torch.equal(following["cost_hazards"] > 0, inside)
        seen += int(inside.sum())
        old, new = ((p["goal"] - p["robot"])[:, 0, :2].norm(dim=-1) for p in (before, now))
        torch.testing.assert_close(following["reward"][:, 0].double(), old - new, rtol=0, atol=1e-6)
        tensordict = following
    assert seen > 0
