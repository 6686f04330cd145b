"""Where things stand at the start, and new goals: rules kept in every layout, distributions."""

import itertools
import math
import time

import numpy as np
import pytest
import torch
from crafting import kind_of, make, places, position_columns
from scipy import stats
from tensordict import TensorDict

from safe_rl.envs import SUITE, LayoutError, SafetyGymEnv, resolve

NUM_LAYOUTS = 800
POINT = {"robot_base": "point", "task": "none"}
UNLIKELY = 1e-3  # p values below this one would be a finding


# every task and level once, with a robot in turn: only its box differs
STARTS = [name for k, name in enumerate(SUITE) if k // 9 == (k // 3 + k) % 3]


@pytest.fixture(params=STARTS, scope="module")
def fresh(request):
    """Many fresh layouts, none of which has moved."""
    # without substeps, a step computes the costs and rewards of the state that it starts from
    return make(resolve(request.param).replace(frameskip_binom_p=0.0), NUM_LAYOUTS)


def fresh_places(config: dict, num_envs: int) -> dict[str, np.ndarray]:
    env = make(config, num_envs)
    return {key: xy.numpy() for key, xy in places(env, env.get_state()).items()}


def test_layouts_keep_their_distances_and_bounds(fresh):
    found = places(fresh, fresh.get_state())
    if fresh.config.task == "button":
        del found["goal"]  # it is where one of the buttons is
    kinds = {one: kind_of(one) for one in found}
    plural = {one: f"{kind}s" if one != kind else kind for one, kind in kinds.items()}
    keepouts = {one: getattr(fresh.config, f"{kind}_keepout") for one, kind in plural.items()}
    half = fresh.config.placements_extents[-1]
    for one, xy in found.items():
        limit = half - keepouts[one]
        assert xy.abs().max() <= limit + 1e-9, one
        assert xy.abs().max() >= 0.97 * limit, f"{one} never comes near the edge"
    for one, other in itertools.combinations(found, 2):
        least = keepouts[one] + keepouts[other]
        distance = (found[one] - found[other]).norm(dim=-1)
        assert distance.min() >= least - 1e-9, (one, other)


def test_no_episode_starts_with_a_cost_or_a_met_goal(fresh):
    got = fresh.step(fresh.full_action_spec.zero())["next"]
    for key in (*fresh.cost_keys, "goal_met", "reward"):
        assert not got[key].any(), key


def test_a_single_object_is_uniform_in_its_rectangle():
    config = {**POINT, "placements_extents": [-1, 0, 3, 1.5], "robot_keepout": 0.25}
    state = make(config, 4000).get_state()
    x, y, yaw = state["qpos"].numpy().T
    assert stats.kstest(x, stats.uniform(-0.75, 3.5).cdf).pvalue > UNLIKELY
    assert stats.kstest(y, stats.uniform(0.25, 1.0).cdf).pvalue > UNLIKELY
    assert stats.kstest(yaw, stats.uniform(0, 2 * math.pi).cdf).pvalue > UNLIKELY
    for one, other in itertools.combinations((x, y, yaw), 2):
        assert stats.spearmanr(one, other).pvalue > UNLIKELY


def test_rectangles_are_chosen_in_proportion_to_their_areas():
    rectangles = [[-2, -2, -1, -1], [0, 0, 2, 1], [-2, 1, -1.5, 1.5]]
    config = {**POINT, "robot_placements": rectangles, "robot_keepout": 0.1}
    # others may have more of them, and are far away
    config |= {"hazards_num": 1, "hazards_placements": [[8, 8, 9, 9]] * 5}
    x, y = fresh_places(config, 4000)["robot"].T
    inside = [(x > a) & (x < c) & (y > b) & (y < d) for a, b, c, d in rectangles]
    counts = np.sum(inside, axis=1)
    assert counts.sum() == 4000
    areas = np.array([0.8 * 0.8, 1.8 * 0.8, 0.3 * 0.3])  # less the keepouts
    assert stats.chisquare(counts, 4000 * areas / areas.sum()).pvalue > UNLIKELY


def draw(rng, keepouts: dict, name: str, placed: dict, half: float, tries: int = 100):
    """The first of some places that keeps the distances to what is placed, or None."""
    mine = keepouts[name]
    for _ in range(tries):
        xy = rng.uniform(mine - half, half - mine, 2)
        if all(math.dist(xy, there) >= mine + keepouts[one] for one, there in placed.items()):
            return xy
    return None


def by_the_rule(rng, keepouts: dict[str, float], half: float, number: int) -> dict:
    """Many layouts: one thing after the other, all again where one does not fit.

    Then the first goals are drawn once more.
    """
    layouts: list[dict] = []
    while len(layouts) < number:
        placed: dict = {}
        for name in keepouts:
            placed[name] = draw(rng, keepouts, name, placed, half)
            if placed[name] is None:
                break
        else:
            del placed["goal"]
            placed["goal"] = draw(rng, keepouts, "goal", placed, half, tries=10_000)
            layouts.append(placed)
    return {name: np.array([layout[name] for layout in layouts]) for name in keepouts}


def test_crowded_layouts_are_distributed_as_by_the_rule_itself():
    config = {
        **{"robot_base": "point", "task": "goal", "placements_extents": [-1, -1, 1, 1]},
        **{"goal_keepout": 0.3, "hazards_num": 3, "hazards_keepout": 0.25},
    }
    got = fresh_places(config, 2000)
    keepouts = {"robot": 0.4, "goal": 0.3, **{f"hazard{i}": 0.25 for i in range(3)}}
    want = by_the_rule(np.random.default_rng(0), keepouts, 1.0, 2000)
    for name in keepouts:
        for column in (0, 1):
            pair = got[name][:, column], want[name][:, column]
            assert stats.ks_2samp(*pair).pvalue > UNLIKELY, name
    for one, other in itertools.combinations(keepouts, 2):
        pair = (np.linalg.norm(xy[one] - xy[other], axis=1) for xy in (got, want))
        assert stats.ks_2samp(*pair).pvalue > UNLIKELY, (one, other)


def test_first_goals_are_drawn_beside_everything_that_stands():
    """Objects keep clear of the goal that the layout had, which is then drawn anew."""
    goals = fresh_places(resolve("PointPush2"), 3000)["goal"]
    # What was measured of the original environment, ± its standard error.
    measured = np.abs(goals).max(axis=1).mean()
    assert measured == pytest.approx(1.165, abs=3 * 0.008 * math.sqrt(2))


def test_a_goal_without_a_second_place_keeps_its_first():
    """The pinned goal can only be drawn at its point again, up to the tolerance."""
    pins = {"robot_locations": [[0, 0]], "goal_locations": [[0.8, 0]], "goal_keepout": 0.4}
    got = fresh_places({"robot_base": "point", "task": "goal", **pins}, 20)["goal"]
    np.testing.assert_allclose(got, [[0.8, 0.0]] * 20, atol=1e-9)


def test_each_object_gets_a_hundred_tries():
    """Where the goal fits one time in a hundred, it finds a place in 63 % of all layouts."""
    spot = 5.0 + 1e-3
    robot = [[4.9 - spot, -spot, 4.9 + spot, spot], [-50 - spot, -spot, -50 + spot, spot]]
    config = {
        **{"robot_base": "point", "task": "goal", "robot_keepout": 5.0, "goal_keepout": 0.0},
        **{"robot_placements": robot, "goal_placements": [[0, 0, 10, 0]]},
    }
    crowded = int((fresh_places(config, 3000)["robot"][:, 0] > 0).sum())
    fits = 1 - 0.99**100
    assert stats.binomtest(crowded, 3000, fits / (fits + 1)).pvalue > UNLIKELY


def test_pinned_layouts():
    config = {
        **{"robot_base": "point", "task": "push", "robot_locations": [[-1.5, -1.5]]},
        **{"robot_rot": 0.3, "box_locations": [[0, 1]], "box_rots": [0.4]},
        **{"goal_locations": [[1, 1]], "vases_num": 3, "vases_rots": [0.5, 0.6, 0.7, 0.8]},
        "vases_locations": [[-1, 0], [0, 0], [0.5, -1]],
        **{"hazards_num": 2, "hazards_locations": [[1.5, -1]]},
    }
    env = make(config, 50)
    state = env.get_state()
    found = places(env, state)
    pins = {"robot": (-1.5, -1.5), "box": (0, 1), "goal": (1, 1), "hazard0": (1.5, -1)}
    pins |= {"vase0": (-1, 0), "vase1": (0, 0), "vase2": (0.5, -1)}
    for name, xy in pins.items():
        offset = found.pop(name) - torch.tensor(xy, dtype=torch.float64)
        assert offset.abs().max() <= 1e-9, name
    assert (env.get_positions()["goal"][:, 0, :2] - 1).abs().max() <= 1e-9
    assert (found.pop("hazard1").std(0) > 0.5).all()
    assert not found
    # Robot, then per body x, y, z and a quaternion about z: vases, box.
    quaternion = state["qpos"][:, 3:].unflatten(1, (4, 7))[..., 3:]
    yaw = 2 * torch.atan2(quaternion[..., 3], quaternion[..., 0])
    want = torch.tensor([0.5, 0.6, 0.7, 0.4], dtype=torch.float64).expand(50, 4)
    torch.testing.assert_close(yaw, want)
    assert (state["qpos"][:, 2] == 0.3).all()


HOPELESS = {
    "placements_margin": (1e9, "'goal' did not fit.*'placements_margin'"),
    "hazards_num": (40, r"'hazard\d+' did not fit.*'hazards_num' is 40.*'hazards_keepout'"),
    "walls_num": (1000, "'goal' did not fit.*'walls_num' is 1000"),
    "hazards_locations": ([[0.0, 0.0]] * 8, "'hazard1' did not fit.*'hazards_locations'"),
}


@pytest.mark.parametrize(
    "key", [pytest.param(k, marks=pytest.mark.slow if k == "walls_num" else ()) for k in HOPELESS]
)
def test_what_never_fits_is_said_within_seconds(key):
    value, words = HOPELESS[key]
    env = SafetyGymEnv(resolve("PointGoal1").replace(**{key: value}), num_envs=100, seed=0)
    begun = time.process_time()
    with pytest.raises(LayoutError, match=words) as caught:
        env.reset()
    assert time.process_time() - begun < 12
    assert len(str(caught.value).splitlines()) == 1


# No substeps, and goals that are met wherever they are: every step draws a new one.
ALWAYS_MET = {"robot_base": "point", "frameskip_binom_p": 0.0, "goal_size": 100.0}
NUM_ENVS = 1000


def stay(env: SafetyGymEnv, state: TensorDict | None = None) -> TensorDict:
    """One step without any action, from a state or the present."""
    tensordict = TensorDict(batch_size=env.batch_size) if state is None else env.set_state(state)
    return env.step(tensordict.set("action", env.action_spec.zero()))["next"]


def test_new_goals_are_uniform_where_they_fit():
    pins = {"robot_locations": [[0, 0]], "hazards_num": 1, "hazards_locations": [[1, 1]]}
    keepouts = {"goal_keepout": 0.2, "robot_keepout": 0.5, "hazards_keepout": 0.3}
    env = make({**ALWAYS_MET, **pins, **keepouts}, NUM_ENVS)
    goals = []
    for _ in range(4):
        assert stay(env)["goal_met"].all()
        goals.append(env.get_state()["goal_pos"])
    got = torch.cat(goals).numpy()
    assert (got[:, 2] == got[0, 2]).all()
    candidates = np.random.default_rng(0).uniform(-1.8, 1.8, (10_000, 2))
    clear = np.hypot(*candidates.T) >= 0.7
    clear &= np.hypot(*(candidates - 1).T) >= 0.5
    want = candidates[clear]
    for measure in (lambda xy: xy[:, 0], lambda xy: xy[:, 1], lambda xy: np.hypot(*xy[:, :2].T)):
        assert stats.ks_2samp(measure(got), measure(want)).pvalue > UNLIKELY
    # A goal does not tell where the next one is.
    assert stats.spearmanr(goals[0][:, 0], goals[1][:, 0]).pvalue > UNLIKELY


MOVED = {
    "robot": {"robot_keepout": 0.6},
    "vase0": {"vases_num": 1, "vases_keepout": 0.6},
    "box": {"task": "push", "box_keepout": 0.6},
    "gremlin0": {"gremlins_num": 1, "gremlins_keepout": 0.6},
}


@pytest.mark.parametrize("name", MOVED)
def test_new_goals_keep_clear_of_where_things_have_moved(name):
    """A gremlin's place is the centre of its circle, wherever it is on it."""
    env = make({**ALWAYS_MET, **MOVED[name], "goal_keepout": 0.2}, NUM_ENVS)
    state = env.get_state()
    before = places(env, state)[name].clone()
    now = 0.5 * torch.randn(NUM_ENVS, 2, dtype=torch.float64)
    state["qpos"][:, position_columns(env)[name]] = now
    assert stay(env, state)["goal_met"].all()
    goal = env.get_state()["goal_pos"][:, :2]
    kept, free = (before, now) if name == "gremlin0" else (now, before)
    assert (goal - kept).norm(dim=-1).min() >= 0.8 - 1e-9
    assert ((goal - free).norm(dim=-1) < 0.8).any(), "the other place was kept clear"


def test_goal_buttons_are_uniform_and_forget_the_last_one():
    # Buttons so large that the robot stands in all of them.
    config = {
        **{"robot_base": "point", "task": "button", "buttons_num": 4, "buttons_size": 1.0},
        **{"placements_extents": [-0.2, -0.2, 0.2, 0.2], "frameskip_binom_p": 0.0},
        **{"buttons_keepout": 0.0, "robot_keepout": 0.0},
    }
    env = make(config, 4000)
    chosen = [env.get_state()["goal_button"]]
    for _ in range(2):
        assert stay(env)["goal_met"].all()
        chosen.append(env.get_state()["goal_button"])
    for buttons in chosen:
        assert stats.chisquare(torch.bincount(buttons, minlength=4).numpy()).pvalue > UNLIKELY
    for before, after in itertools.pairwise(chosen):
        pairs = torch.bincount(4 * before + after, minlength=16)
        assert stats.chisquare(pairs.numpy()).pvalue > UNLIKELY


# A goal that is pinned to where the robot stands has no second place.
NO_PLACE = {"robot_base": "point", "frameskip_binom_p": 0.0, "goal_locations": [[1, 1]]}


def at_the_goal(env: SafetyGymEnv) -> TensorDict:
    state = env.get_state()
    state["qpos"][0, :2] = torch.tensor([1.0, 1.0])
    return state


@pytest.mark.parametrize(("continues", "end"), [(True, "truncated"), (False, "terminated")])
def test_episodes_end_where_no_new_goal_fits_and_where_none_is_wanted(continues, end):
    env = make({**NO_PLACE, "continue_goal": continues}, num_envs=3)
    got = stay(env, at_the_goal(env))
    for key in ("goal_met", "done", "reward", end):
        assert got[key][:, 0].tolist() == [True, False, False], key
    (other,) = {"truncated", "terminated"} - {end}
    assert not got[other].any()


def test_or_it_is_an_error_that_says_what_to_change():
    env = make({**NO_PLACE, "terminate_resample_failure": False}, num_envs=3)
    with pytest.raises(LayoutError, match="terminate_resample_failure"):
        stay(env, at_the_goal(env))
