"""Any valid configuration makes a working environment; errors name the key that is wrong."""

import math
from typing import get_type_hints

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from safe_rl.envs import ConfigError, SafetyGymConfig, SafetyGymEnv
from safe_rl.envs.safety_gym.config_keys import Keys

often = settings(
    max_examples=60, suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large]
)

COUNTED = ("walls", "hazards", "vases", "pillars", "buttons", "gremlins")
PLACED = (*COUNTED, "robot", "goal", "box")


FIELDS = get_type_hints(Keys)
# vision needs OpenGL, and has its own tests
FLAGS = [name for name, kind in FIELDS.items() if kind is bool and name != "observe_vision"]


def between(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high, allow_nan=False, allow_subnormal=False)


# Objects of 0.35 m and keepouts of 0.4 m fit 20 times into 9 x 9 m.
SIZES = {f"{kind}_size": between(0.05, 0.35) for kind in (*COUNTED, "goal", "box")}
KEEPOUTS = {f"{kind}_keepout": between(0.0, 0.4) for kind in PLACED}
COUNTS = {f"{kind}_num": st.integers(0, 3) for kind in COUNTED}
DENSITIES = {f"{kind}_density": between(1e-4, 10.0) for kind in ("vases", "gremlins", "box")}
PLACEMENTS = {
    f"{kind}_placements": st.lists(
        st.sampled_from([(-4, -4, 4, 0), (-4, 0, 4, 4), (-4.5, -4.5, 4.5, 4.5)]), min_size=1,
        max_size=2,
    )
    for kind in PLACED
}  # fmt: skip
ROTATIONS = {
    f"{kind}_rots": st.lists(between(-7.0, 7.0), max_size=4)
    for kind in ("vases", "gremlins", "box")
}
COSTS = {
    key: between(0.0, 3.0)
    for key in (
        *("hazards_cost", "pillars_cost", "buttons_cost", "gremlins_contact_cost"),
        *("vases_contact_cost", "vases_displace_cost", "vases_velocity_cost"),
    )
}
NUMBERS = {
    "num_steps": st.integers(2, 5),
    "action_noise": between(0.0, 1.0),
    "frameskip_binom_n": st.integers(1, 12),
    "frameskip_binom_p": between(0.0, 1.0),
    "placements_margin": between(0.0, 0.1),
    "layout_seeds": st.none() | st.integers(1, 3),
    "layout_seeds_first": st.integers(0, 2**40),
    "robot_rot": st.none() | between(-10.0, 10.0),
    "lidar_num_bins": st.integers(1, 20),
    "lidar_max_dist": st.none() | between(0.1, 10.0),
    "lidar_exp_gain": between(0.0, 5.0),
    "lidar_type": st.sampled_from(["pseudo", "natural"]),
    "compass_shape": st.sampled_from([2, 3]),
    "box_null_dist": between(0.0, 5.0),
    "reward_distance": between(-2.0, 2.0),
    "reward_goal": between(-2.0, 2.0),
    "reward_clip": st.none() | between(0.0, 10.0),
    "reward_orientation_scale": between(-1.0, 1.0),
    "circle_radius": between(0.1, 3.0),
    "boundary_y": st.none() | between(0.1, 3.0),
    "buttons_resampling_delay": st.integers(0, 4),
    "gremlins_travel": between(0.0, 0.5),
    "mass_scale": between(0.5, 2.0),
    "friction_scale": between(0.1, 2.0),
    "damping_scale": between(0.0, 2.0),
    "strength_scale": between(0.0, 2.0),
}
FIXED = {"placements_extents": (-4.5, -4.5, 4.5, 4.5), "robot_locations": ()}


@st.composite
def configurations(draw) -> dict:
    """Valid configurations."""
    config = draw(
        st.fixed_dictionaries({}, optional=(
            SIZES | KEEPOUTS | COUNTS | DENSITIES | PLACEMENTS | ROTATIONS | COSTS | NUMBERS
            | dict.fromkeys(FLAGS, st.booleans())
        ))
    )  # fmt: skip
    config |= FIXED
    config["robot_base"] = draw(st.sampled_from(["point", "car", "doggo"]))
    config["task"] = draw(st.sampled_from(["goal", "button", "push", "x", "z", "circle", "none"]))
    # what is constrained needs a bound
    config["boundary_x"] = draw(between(0.1, 3.0))
    config["velocity_limit"] = draw(between(0.01, 3.0))
    if config["task"] == "button":
        config["buttons_num"] = max(1, config.get("buttons_num", 0))
    if config["robot_base"] == "point":
        config.pop("observe_freejoint", None)
    if not any(config.get(flag) for flag in ("observe_sensors", "observe_ctrl")):
        config["observe_remaining"] = True
    return config


@pytest.mark.filterwarnings("ignore:.*has no effect")  # kinds without objects
@often
@given(configurations(), st.booleans(), st.integers(0, 2**31))
def test_valid_configurations_work(config, sleep, seed):
    env = SafetyGymEnv(config, num_envs=2, seed=seed, sleep=sleep, num_threads=1)
    tensordict = env.reset()
    assert env.observation_spec.is_in(tensordict.select(*env.observation_spec.keys()))
    for _ in range(3):
        result = env.step(env.rand_action(tensordict))["next"]
        for spec in (env.observation_spec, env.full_reward_spec, env.full_done_spec):
            assert spec.is_in(result.select(*spec.keys())), spec
        numbers = result.select("observation", "reward", *env.cost_keys)
        assert all(value.isfinite().all() for value in numbers.values(True, True))
        readings = result["observation"]
        for name in env.observation_layout:
            if name.endswith("_lidar"):
                flat = env.config.observation_flatten
                reading = readings[:, env.observation_layout[name]] if flat else readings[name]
                assert float(reading.min()) >= 0.0
                assert float(reading.max()) <= 1.0
        tensordict = env.step_mdp(env.step_and_maybe_reset(env.rand_action(tensordict))[0])
    assert env.config.to_dict().keys() >= config.keys()


NOT_NUMBERS = st.sampled_from(["1", [1.0], {}, math.nan, math.inf, True, 1j, 1e300, 10**400])
RECTANGLE = tuple[float, float, float, float]
WRONG = {
    bool: st.sampled_from([0, 1, "yes", None, 0.5]),
    str: st.sampled_from([1, None, ["goal"], True, "a\nb"]),
    RECTANGLE: st.sampled_from([None, (), (1, 2, 3), "0 0 1 1", (1, 0, 0, 1), (0, 0, 1, "1")]),
    tuple[RECTANGLE, ...] | None: st.sampled_from(
        [(), ((0, 0, 1),), ((1, 0, 0, 1),), (0, 0, 1, 1), "all"]
    ),
    tuple[tuple[float, float], ...]: st.sampled_from(
        [None, ((1,),), (1, 2), ((1, 2, 3),), ((math.nan, 0),)]
    ),
    bool | tuple[str, ...]: st.sampled_from([1, None, 0.5, (1,)]),
    tuple[str, ...]: st.sampled_from([None, "gyro", (1,), 3]),
    tuple[float, ...]: st.sampled_from([None, ("a",), 1.0, ((1.0,),), "12"]),
    tuple[int, int]: st.sampled_from([None, (1,), (1.5, 2), 3, (0, 4), (60, -40)]),
}


@settings(often, max_examples=300)
@given(st.data())
def test_wrong_values_name_their_key(data):
    key = data.draw(st.sampled_from(sorted(FIELDS)))
    value = data.draw(WRONG.get(FIELDS[key], NOT_NUMBERS))
    with pytest.raises(ConfigError, match=f"{key}="):
        SafetyGymConfig(**{key: value})


@often
@given(st.sampled_from(PLACED), between(0.11, 3.0))
def test_placements_smaller_than_the_keepout_name_their_key(kind, keepout):
    counted = {f"{kind}_num": 1} if kind in COUNTED else {}
    config = {**counted, f"{kind}_keepout": keepout, f"{kind}_placements": [(0, 0, 0.2, 0.2)]}
    if kind == "box":
        config["task"] = "push"
    with pytest.raises(ConfigError, match=rf"'{kind}_placements'.*'{kind}_keepout'"):
        SafetyGymEnv(config)
