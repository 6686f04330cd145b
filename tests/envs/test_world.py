"""Objects in the compiled world: shape, size, weight, height, colour, and what they stop."""

import mujoco
import numpy as np
import pytest
import torch
from crafting import arrange

from safe_rl.envs import SafetyGymConfig, SafetyGymEnv
from safe_rl.envs.safety_gym.building import build_scene

BOX, CYLINDER, SPHERE = (int(getattr(mujoco.mjtGeom, f"mjGEOM_{name}"))
                         for name in ("BOX", "CYLINDER", "SPHERE"))  # fmt: skip
# Rays need all of these as geoms. No size is the default.
CONFIG = SafetyGymConfig(
    **{"robot_base": "point", "task": "push", "lidar_type": "natural"},
    **{
        f"{kind}_num": 1 for kind in ("walls", "hazards", "vases", "pillars", "buttons", "gremlins")
    },
    **{"goal_size": 0.4, "box_size": 0.16, "box_density": 0.02, "walls_size": 0.6},
    **{"hazards_size": 0.22, "vases_size": 0.13, "vases_density": 0.03, "vases_sink": 0.01},
    **{"pillars_size": 0.17, "pillars_height": 0.7, "buttons_size": 0.12, "gremlins_size": 0.11},
    **{"gremlins_density": 0.04},
)
# Per object: height of the centre; type, size, group, rgb, whether it collides.
WORLD = {
    "goal": (0.21, CYLINDER, (0.4, 0.2), 0, (0, 1, 0), False),
    "box": (0.16, BOX, (0.16, 0.16, 0.16), 1, (1, 1, 0), True),
    "wall0": (0.6, BOX, (0.6, 0.6, 0.6), 2, (0.5, 0.5, 0.5), True),
    "hazard0": (0.02, CYLINDER, (0.22, 0.01), 3, (0, 0, 1), False),
    "vase0": (0.12, BOX, (0.13, 0.13, 0.13), 4, (0, 1, 1), True),
    "pillar0": (0.7, CYLINDER, (0.17, 0.7), 2, (0.5, 0.5, 1), True),
    "button0": (0.12, SPHERE, (0.12,), 1, (1, 0.5, 0), True),
    "gremlin0": (0.11, BOX, (0.11, 0.11, 0.11), 5, (0.5, 0, 1), True),
}
MASSES = {"vase0": 0.03 * 0.26**3, "gremlin0": 0.04 * 0.22**3}


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return build_scene(CONFIG).model


def geoms_of(model: mujoco.MjModel, name: str) -> range:
    body = model.body(name)
    return range(int(body.geomadr[0]), int(body.geomadr[0] + body.geomnum[0]))


@pytest.mark.parametrize("name", WORLD)
def test_objects_are_what_the_specification_says(model, name):
    height, shape, size, group, rgb, collides = WORLD[name]
    assert model.body(name).pos[2] == pytest.approx(height)
    first, *_ = geoms_of(model, name)
    assert model.geom_type[first] == shape
    np.testing.assert_allclose(model.geom_size[first][: len(size)], size)
    for geom in geoms_of(model, name):
        assert model.geom_group[geom] == group
        np.testing.assert_allclose(model.geom_rgba[geom], [*rgb, 1.0 if collides else 0.25])
        assert bool(model.geom_contype[geom]) == bool(model.geom_conaffinity[geom]) == collides
        assert model.geom_condim[geom] == 6


@pytest.mark.parametrize("name", MASSES)
def test_movable_objects_weigh_their_volume(model, name):
    assert model.body(name).mass[0] == pytest.approx(MASSES[name])


def test_the_box_has_four_posts(model):
    s = 0.16
    main, *posts = geoms_of(model, "box")
    assert {tuple(np.round(model.geom_pos[post], 9)) for post in posts} == {
        (x * s, y * s, 0.0) for x in (-1, 1) for y in (-1, 1)
    }
    for post in posts:
        np.testing.assert_allclose(model.geom_size[post], [s / 2, s / 2, s])
    volume = (2 * s) ** 3 + 4 * s * s * 2 * s
    assert model.body("box").mass[0] == pytest.approx(0.02 * volume)
    assert not model.geom_pos[main].any()


def test_the_floor_and_the_gremlins_weld(model):
    floor = model.geom("floor").id
    assert model.geom_type[floor] == int(mujoco.mjtGeom.mjGEOM_PLANE)
    np.testing.assert_allclose(model.geom_size[floor][:2], 3.5)
    assert (model.geom_condim[floor], model.geom_group[floor]) == (6, 0)
    assert model.neq == 1
    np.testing.assert_allclose(model.eq_solref[0], [0.02, 1.5])
    (target,) = geoms_of(model, "gremlin0_target")
    assert not model.geom_contype[target]
    assert model.geom_group[target] == 5


def test_the_circle_lies_around_the_origin():
    model = build_scene(CONFIG.replace(task="circle", circle_radius=1.1), decorated=True).model
    (circle,) = geoms_of(model, "circle")
    np.testing.assert_allclose(model.geom_size[circle][:2], [1.1, 0.01])
    assert model.geom_group[circle] == 6
    assert not model.geom_contype[circle]
    assert not model.body("circle").pos[:2].any()


def test_areas_are_no_bodies_where_nothing_looks_at_them():
    bare = build_scene(CONFIG.replace(lidar_type="pseudo")).model
    names = {bare.body(i).name for i in range(bare.nbody)}
    assert not {"goal", "hazard0", "circle"} & names
    assert {"wall0", "pillar0", "vase0"} <= names


STOPS = {"walls": 0.6 - 0.25, "pillars": 0.6 - 0.2, "buttons": 0.6 - 0.1, "hazards": None}


@pytest.mark.parametrize("kind", STOPS)
def test_static_objects_stop_the_robot_and_areas_do_not(kind):
    config = {"robot_base": "point", "task": "none", f"{kind}_num": 1, "walls_size": 0.25}
    env = SafetyGymEnv(config, num_envs=1, seed=0, sleep=False, num_threads=1)
    env.reset()
    tensordict = env.set_state(arrange(env, **{"robot": (0, 0, 0), f"{kind[:-1]}0": (0.6, 0)}))
    for _ in range(120):
        tensordict = env.step_mdp(env.step(tensordict.set("action", torch.tensor([[1.0, 0.0]]))))
    x = float(env.get_state()["qpos"][0, 0])
    if STOPS[kind] is None:
        assert x > 0.7
    else:  # its arrow reaches 0.15 m ahead
        assert x == pytest.approx(STOPS[kind] - 0.15, abs=0.01)


def test_keys_that_nothing_reads_change_nothing():
    def rollout(**keys) -> torch.Tensor:
        config = {"robot_base": "point", "gremlins_num": 2, "constrain_gremlins": True, **keys}
        env = SafetyGymEnv(config, num_envs=2, seed=0, num_threads=1)
        torch.manual_seed(0)
        steps = env.rollout(5)["next"]
        return torch.cat([steps["observation"], steps["cost"]], -1)

    assert torch.equal(rollout(), rollout(gremlins_dist_threshold=9.0, gremlins_dist_cost=7.0))
