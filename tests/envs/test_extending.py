"""Rows from outside the package are placed, simulated, observed and charged like built-in ones."""

import math
from dataclasses import replace

import crafting
import numpy as np
import pytest
import torch
from crafting import arrange, assert_same, observe, play, step_from
from registrations import MINES, POINT, cube, disc, inside, register_mines
from torchrl.envs.utils import check_env_specs

from safe_rl.envs import ConfigError, SafetyGymEnv, resolve
from safe_rl.envs.extending import (
    BOX,
    Cost,
    Geom,
    Motion,
    Reading,
    Task,
    contact_cost,
    register_cost,
    register_element,
    register_observation,
    register_task,
)
from safe_rl.envs.safety_gym.tasks import TASKS

pytestmark = pytest.mark.usefixtures("registrations_undone")


def make(config: dict, num_envs: int = 1) -> SafetyGymEnv:
    return crafting.make({**POINT, **config}, num_envs)


def test_areas_are_placed_seen_and_cost():
    register_mines()
    env = make({**MINES, "constrain_indicator": False, "lidar_alias": False, "lidar_num_bins": 4})
    assert env.object_names == ("mine0", "mine1")
    assert env.cost_keys == ["cost", "cost_mines", "cost_exception"]
    state = arrange(env, robot=(0, 0, 0), mine0=(0.1, 0.1), mine1=(0, -2))
    reading = observe(env, robot=(0, 0, 0), mine0=(0.1, 0.1), mine1=(0, -2))["mines_lidar"]
    np.testing.assert_allclose(reading, [math.exp(-math.sqrt(0.02)), 0, 0, math.exp(-2)], rtol=1e-6)
    result = step_from(env, state, 0.0, 0.0)
    assert float(result["cost_mines"]) == float(result["cost"]) == 2.5
    assert not step_from(env, arrange(env, mine0=(0.5, 0)), 0.0, 0.0)["cost"].any()
    check_env_specs(env)


def test_static_bodies_stop_the_robot_and_contacts_can_cost():
    register_element(cube("bollards", "bollard", Motion.STATIC))
    cost = Cost(
        "cost_bollards",
        flags=("constrain_bollards",),
        magnitude=lambda c, w: contact_cost(w.contacts_with("bollards")),
        touches=("bollards",),
    )
    register_cost(cost, keys={"constrain_bollards": False})
    env = make({"bollards_num": 1, "constrain_bollards": True})
    start = env.set_state(arrange(env, robot=(0, 0, 0), bollard0=(0.6, 0)))
    forwards = lambda td: td.set("action", torch.tensor([[1.0, 0.0]]))  # noqa: E731
    taken = env.rollout(150, forwards, auto_reset=False, tensordict=start)
    costs = taken["next", "cost_bollards"].flatten().tolist()
    # The robot's arrow reaches 0.15 m ahead, the bollard 0.1 m back.
    assert float(env.get_state()["qpos"][0, 0]) == pytest.approx(0.6 - 0.1 - 0.15, abs=5e-3)
    assert costs[0] == 0.0
    assert costs[-1] == 1.0


@pytest.mark.parametrize(("kind", "touches"), [("walls", ()), ("hazards", ("hazards",))])
def test_contacts_that_nothing_counts_are_an_error_that_says_so(kind, touches):
    register_cost(Cost("cost_odd", (), lambda c, w: w.contacts_with(kind).sum(-1), touches))
    with pytest.raises(KeyError, match=rf"'{kind}'.*'touches'.*Areas"):
        make({f"{kind}_num": 1}).rollout(1)


@pytest.mark.parametrize("read", ["at", "start_of", "velocity_of", "contacts_with"])
def test_a_misspelt_kind_is_an_error_and_one_without_objects_is_not(read):
    def touched(kind):
        return lambda config, world: getattr(world, read)(kind).flatten(1).sum(-1)

    register_cost(Cost("cost_touch", (), touched("vases")))
    assert make({}).rollout(1)["next", "cost_touch"].item() == 0
    register_cost(Cost("cost_touch", (), touched("vase")))
    with pytest.raises(ConfigError, match=r"no kind 'vase' of objects. Did you mean 'vases'\?"):
        make({}).rollout(1)


def wrong_cost(magnitude):
    register_cost(Cost("cost_odd", (), magnitude))


def wrong_task(reward, **others):
    register_task("odd", Task(reward, **others))


GOAL = {"elements": ("goal",), "met": lambda c, w, now: w.robot_pos[:, :1] > 0}
FLAT = replace(cube("cones", "cone", Motion.FREE), geoms=lambda c: (Geom(BOX, (0.1, 0.1)),))
ONE_GEOM = replace(cube("cones", "cone", Motion.FREE), geoms=lambda c: Geom(BOX, (0.1,) * 3))
WRONG = {
    "two per world": (lambda: wrong_cost(lambda c, w: w.robot_xy), r"cost_odd .*\[2\].* \[2, 2\]"),
    "no number": (lambda: wrong_cost(lambda c, w: w.up * math.nan), "cost_odd must be 0 or more"),
    "infinite": (lambda: wrong_cost(lambda c, w: w.up / 0), "cost_odd must be 0 or more"),
    "size": (lambda: register_element(FLAT, {"cones_num": 1}), "(?s)size 2 must be.*your elements"),
    "geoms": (lambda: register_element(ONE_GEOM, {"cones_num": 1}), "^'geoms' of 'cones' must ret"),
    "key": (lambda: wrong_cost(lambda c, w: c.goal_sise * w.up), "'goal_sise'.*'goal_size'"),
    "reward": (lambda: wrong_task(lambda c, w, b, n: 1.0), r"'reward' .*\[2\].* a float"),
    "no reward": (lambda: wrong_task(lambda c, w, b, n: w.up / 0), "'reward' .* NaN or infinite"),
    "no bodies": (lambda: wrong_cost(lambda c, w: w.velocity_of("hazards")), "'hazards' are not"),
    "met": (lambda: wrong_task(lambda c, w, b, n: w.up, **GOAL), r"'met' .*\[2\].* \[2, 1\]"),
    "observation": (
        lambda: register_observation(
            Reading("odd", (), lambda c, scene: 3, lambda w: w.qpos[:, :2])
        ),
        r"'odd' .*\[2, 3\].* \[2, 2\]",
    ),
}


@pytest.mark.parametrize(("register", "told"), WRONG.values(), ids=WRONG)
def test_rows_that_return_something_else_are_named(register, told):
    register()
    task = "odd" if "odd" in TASKS else "none"
    with pytest.raises((ConfigError, AttributeError), match=told):
        SafetyGymEnv({**POINT, "task": task, "hazards_num": 1}, num_envs=2, seed=0).rollout(1)


def test_free_bodies_are_pushed_and_have_a_density():
    register_element(cube("crates", "crate", Motion.FREE), keys={"crates_density": 0.5})
    env = make({"crates_num": 1, "crates_rots": [0.3], "vases_num": 1, "task": "push"})
    assert env.object_names == ("vase0", "box", "crate0", "goal")
    state = env.get_state()
    assert state["qpos"].shape == (1, 3 + 3 * 7)
    quat = torch.tensor([[math.cos(0.15), 0, 0, math.sin(0.15)]], dtype=torch.float64)
    torch.testing.assert_close(state["qpos"][:, -4:], quat)
    model = env._world.scene.model
    assert model.body("crate0").mass[0] == pytest.approx(0.5 * 0.2**3)
    assert model.body("vase0").mass[0] == pytest.approx(0.001 * 0.2**3)


def test_guided_bodies_run_circles_of_their_own():
    register_element(cube("drones", "drone", Motion.GUIDED, group=5), keys={"drones_travel": 0.6})
    env = make({"drones_num": 1, "gremlins_num": 1, "robot_locations": [[9, 9]]})
    assert env.object_names == ("gremlin0", "drone0")
    radii = []
    for _ in range(400):
        env.step(env.full_action_spec.zero())
        state = env.get_state()
        offset = state["qpos"][0, 3:].view(2, 7)[:, :2] - state["layout"][0, 1:]
        radii.append(offset.norm(dim=-1))
    # Dragged by a stiff damped spring, they run close to their targets' circles.
    torch.testing.assert_close(
        torch.stack(radii)[200:].mean(0), torch.tensor([0.3, 0.6]).double(), rtol=0.02, atol=0
    )
    heights = env.get_state()["qpos"][0, 3:].view(2, 7)[:, 2]
    torch.testing.assert_close(heights, torch.tensor([0.2, 0.2]).double(), atol=5e-3, rtol=0)


FOLLOW = Task(
    reward=lambda c, w, before, now: c.reward_follow * (before - now)[:, 0],
    measure=lambda w: (w.at("beacon")[:, :, :2] - w.robot_pos[:, None, :2]).norm(dim=-1),
    elements=("beacon",),
)


def test_tasks_bring_objects_and_keys():
    register_element(disc("beacon", "beacon"), keys={"beacon_size": 0.2})
    register_task("follow", FOLLOW, keys={"reward_follow": 3.0})
    assert make({}).object_names == ()
    env = make({"task": "follow", "observe_beacon": True})
    assert env.object_names == ("beacon",)
    assert "beacon_lidar" in env.observation_layout
    state = arrange(env, robot=(0, 0, 0), beacon=(2, 0))
    state["qvel"][:, 0] = 0.5
    result, after = step_from(env, state, 0.0, 0.0), env.get_state()
    assert float(after["qpos"][0, 0]) > 5e-3
    assert float(result["reward"]) == pytest.approx(3.0 * float(after["qpos"][0, 0]), rel=1e-5)
    with pytest.raises(ConfigError, match=r"'folow'.*'follow'"):
        make({"task": "folow"})
    with pytest.raises(ConfigError, match=r"'goal' must stand in a tuple: \('goal',\)"):
        register_task("visit", Task(FOLLOW.reward, elements="goal"))


def test_tasks_with_goals_of_their_own():
    register_task(
        "visit",
        Task(
            reward=lambda c, w, before, now: torch.zeros_like(now[:, 0]),
            measure=lambda w: (w.at("goal")[..., :2] - w.robot_pos[:, None, :2]).norm(dim=-1),
            met=lambda c, w, now: now[:, 0] < c.visit_radius,
            elements=("goal",),
        ),
        keys={"visit_radius": 1.5},
    )
    env = make({"task": "visit", "observe_goal_dist": True})
    result = step_from(env, arrange(env, robot=(0, 0, 0), goal=(1.4, 0)), 0.0, 0.0)
    assert bool(result["goal_met"])
    assert float(result["reward"]) == 1.0
    assert not torch.allclose(env.get_state()["goal_pos"][0, :2], torch.tensor([1.4, 0]).double())
    assert not step_from(env, arrange(env, robot=(0, 0, 0), goal=(1.6, 0)), 0.0, 0.0)["goal_met"]


def test_observations_are_sorted_in_and_may_feel_contacts():
    touch = Reading(
        "feel",
        flags=("observe_feel",),
        size=lambda c, scene: c.pillars_num,
        read=lambda w: w.contacts_with("pillars"),
        touches=("pillars",),
    )
    register_observation(touch, keys={"observe_feel": False})
    assert "feel" not in make({}).observation_layout
    env = make({"observe_feel": True, "pillars_num": 2, "observe_pillars": True})
    assert list(env.observation_layout) == ["feel", "gyro", "pillars_lidar"]
    felt = observe(env, robot=(0, 0, math.pi), pillar0=(3, 3), pillar1=(0.299, 0))["feel"]
    assert felt.tolist() == [0, 1]
    check_env_specs(env)


def test_the_suite_stays_what_it_was():
    def run():
        env = SafetyGymEnv("CarButton1", num_envs=3, seed=1, num_threads=1)
        return play(env, env.reset(), 5)

    before = run()
    register_mines()
    register_element(cube("drones", "drone", Motion.GUIDED))
    register_element(cube("crates", "crate", Motion.FREE))
    assert_same(run(), before)
    assert resolve("CarButton1").drones_num == 0


def test_registering_again_replaces_the_row():
    register_mines()
    make(MINES)
    register_element(disc("mines", "bomb"), keys={"mines_size": 0.4})
    register_cost(Cost("cost_mines", ("constrain_mines",), lambda c, w: 7.0 * inside(c, w)))
    env = make({**MINES, "constrain_indicator": False, "hazards_num": 1})
    assert env.object_names == ("hazard0", "bomb0", "bomb1")
    result = step_from(env, arrange(env, robot=(0, 0), bomb0=(0.3, 0), bomb1=(5, 5)), 0.0, 0.0)
    assert float(result["cost_mines"]) == 7.0 * 2.5
