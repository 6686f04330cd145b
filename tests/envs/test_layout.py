"""Where things stand at the start: rules kept in every layout of the suite, and distributions."""

import itertools
import math
import time

import numpy as np
import pytest
import torch
from crafting import kind_of, make, places
from scipy import stats
from tensordict import TensorDict

from safe_rl.envs import SUITE, LayoutError, SafetyGymEnv, resolve

NUM_LAYOUTS = 800
# Without substeps, a step computes the costs and rewards of the state that it starts from.
FROZEN = {"frameskip_binom_p": 0.0}
POINT = {"robot_base": "point", "task": "none"}
UNLIKELY = 1e-3  # p values below this one would be a finding


# every task and level once, with a robot in turn: only its box differs
STARTS = [name for k, name in enumerate(SUITE) if k // 9 == (k // 3 + k) % 3]


@pytest.fixture(params=STARTS, scope="module")
def start(request):
    """Name, environment and first TensorDict of many fresh layouts, none of which has moved."""
    config = resolve(request.param).replace(**FROZEN)
    env = make(config, NUM_LAYOUTS)
    return request.param, env, TensorDict(batch_size=[NUM_LAYOUTS])


def fresh_places(config: dict, num_envs: int) -> dict[str, np.ndarray]:
    env = make(config, num_envs)
    return {key: xy.numpy() for key, xy in places(env, env.get_state()).items()}


def test_layouts_keep_their_distances_and_bounds(start):
    name, env, _ = start
    found = places(env, env.get_state())
    if "Button" in name:
        del found["goal"]  # it is where one of the buttons is
    kinds = {one: kind_of(one) for one in found}
    plural = {one: f"{kind}s" if one != kind else kind for one, kind in kinds.items()}
    keepouts = {one: getattr(env.config, f"{kind}_keepout") for one, kind in plural.items()}
    half = env.config.placements_extents[-1]
    for one, xy in found.items():
        limit = half - keepouts[one]
        assert xy.abs().max() <= limit + 1e-9, one
        assert xy.abs().max() >= 0.97 * limit, f"{one} never comes near the edge"
    for one, other in itertools.combinations(found, 2):
        least = keepouts[one] + keepouts[other]
        distance = (found[one] - found[other]).norm(dim=-1)
        assert distance.min() >= least - 1e-9, (one, other)


def test_no_episode_starts_with_a_cost_or_a_met_goal(start):
    _, env, tensordict = start
    got = env.step(tensordict.set("action", env.action_spec.zero()))["next"]
    for key in env.cost_keys:
        assert not got[key].any(), key
    assert not got["goal_met"].any()
    assert not got["reward"].any()


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


def fits(xy: np.ndarray, placed: list[np.ndarray], clearances: list[float]) -> bool:
    pairs = zip(placed, clearances, strict=True)
    return all(math.dist(xy, other) >= clearance for other, clearance in pairs)


def by_rejection(rng, keepouts: list[float], half: float) -> np.ndarray | None:
    """One layout by the rule itself: place one after the other, 100 tries each."""
    placed: list[np.ndarray] = []
    for keepout in keepouts:
        clearances = [keepout + theirs for theirs in keepouts[: len(placed)]]
        tries = (rng.uniform(keepout - half, half - keepout, 2) for _ in range(100))
        found = next((xy for xy in tries if fits(xy, placed, clearances)), None)
        if found is None:
            return None
        placed.append(found)
    return np.array(placed)


def by_the_rule(rng, keepouts: dict[str, float], half: float, number: int) -> dict:
    """Many layouts, drawn again where something does not fit; then the first goals, once more."""
    layouts: list[np.ndarray] = []
    names, sizes = list(keepouts), list(keepouts.values())
    goal, mine = names.index("goal"), keepouts["goal"]
    while len(layouts) < number:
        layout = by_rejection(rng, sizes, half)
        if layout is None:
            continue
        others = np.delete(layout, goal, axis=0)
        clearances = [mine + theirs for theirs in np.delete(sizes, goal)]
        while not fits(xy := rng.uniform(mine - half, half - mine, 2), others, clearances):
            pass
        layout[goal] = xy
        layouts.append(layout)
    return dict(zip(names, np.array(layouts).transpose(1, 0, 2), strict=True))


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
