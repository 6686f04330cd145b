"""Finite sets of layouts, to train on some and to evaluate on others; layouts drawn ahead."""

import pytest
import torch
from scipy.stats import chisquare
from tensordict import TensorDict

from safe_rl.envs import LayoutError, SafetyGymEnv, resolve
from safe_rl.envs.rng import DrawnAhead

# What a layout pins: positions, yaws, the first goal button.
PINNED = ("layout", "start_pose", "qpos", "goal_pos", "goal_button", "target_quat")


def starts(name: str, num_layouts: int | None, first: int = 0, *, num_envs: int = 40, seed: int = 0,
           resets: int = 1, **keys) -> TensorDict:  # fmt: skip
    """States at the start of episodes [resets * num_envs]."""
    config = resolve(name).replace(layout_seeds=num_layouts, layout_seeds_first=first, **keys)
    env = SafetyGymEnv(config, num_envs=num_envs, seed=seed, num_threads=1)
    states = []
    for _ in range(resets):
        env.reset()
        states.append(env.get_state())
    return torch.cat(states)


def identify(states: TensorDict) -> list[tuple[float, ...]]:
    """A value per state that is equal for equal layouts."""
    pinned = torch.cat([states[key].double().reshape(len(states), -1) for key in PINNED], 1)
    return [tuple(row) for row in pinned.tolist()]


@pytest.mark.parametrize("name", ["PointGoal1", "CarButton2", "DoggoPush1"])
def test_there_are_as_many_layouts_as_asked_for_whatever_the_seed(name):
    some = identify(starts(name, 5, resets=3))
    others = identify(starts(name, 5, resets=3, seed=1))
    assert len(set(some)) == 5
    assert set(some) == set(others)
    # Which one comes when is the environment's own choice.
    assert some != others
    assert len(set(some[:40])) > 1
    assert [row for row in zip(some[:40], some[40:80], strict=True) if row[0] != row[1]]


def test_disjoint_ranges_share_no_layout():
    training = set(identify(starts("PointGoal1", 20, first=0, resets=5)))
    evaluation = set(identify(starts("PointGoal1", 20, first=20, resets=5)))
    together = set(identify(starts("PointGoal1", 40, first=0, resets=10)))
    assert len(training) == len(evaluation) == 20
    assert not training & evaluation
    assert training | evaluation == together


def test_layouts_are_picked_uniformly():
    picked = identify(starts("PointGoal0", 4, num_envs=400))
    counts = [picked.count(layout) for layout in set(picked)]
    assert len(counts) == 4
    assert chisquare(counts).pvalue > 1e-3


def test_later_goals_are_not_part_of_the_layout():
    config = resolve("PointGoal0").replace(layout_seeds=1, goal_size=5.0)
    env = SafetyGymEnv(config, num_envs=20, seed=0, num_threads=1)
    tensordict = env.reset()
    assert len(torch.unique(env.get_state()["goal_pos"], dim=0)) == 1
    env.step(tensordict.set("action", torch.zeros(20, 2)))
    assert len(torch.unique(env.get_state()["goal_pos"], dim=0)) == 20


def test_a_single_layout_is_one_of_the_set():
    single = identify(starts("PointGoal1", 6, resets=4, randomize_layout=False))
    assert len(set(single)) == 1
    assert single[0] in set(identify(starts("PointGoal1", 6, num_envs=100)))
    seeds = [identify(starts("PointGoal1", 6, seed=i, num_envs=1, randomize_layout=False))[0]
             for i in range(8)]  # fmt: skip
    assert len(set(seeds)) > 1


def draw(key):
    """Layouts [B, 1, 2] that hold their key; none for keys above 100."""
    if (key > 100).any():
        raise LayoutError("'hazard0' did not fit.")
    return key.view(-1, 1, 1).expand(-1, 1, 2).double()


def mask_of(*rows):
    return torch.isin(torch.arange(3), torch.tensor(rows))


def test_an_episode_that_may_never_come_has_no_say():
    layouts = DrawnAhead(draw, (3, 1, 2))
    key = torch.tensor([1, 2, 3])
    assert layouts(key, torch.tensor([4, 5, 500]), mask_of(0))[0].tolist() == [[1, 1]]
    assert layouts(key, key, mask_of(1))[1].tolist() == [[2, 2]]
    with pytest.raises(LayoutError, match="hazard0"):
        layouts(torch.tensor([6, 7, 500]), key, mask_of(2))
    assert layouts(key, key, mask_of(2))[2].tolist() == [[3, 3]]


@pytest.mark.parametrize("env", ["PointGoal1", "PointButton2", "PointPush2"])
@pytest.mark.parametrize("layout_seeds", [None, 5])
def test_rows_begin_the_same_episodes_whenever_and_leave_each_other_alone(env, layout_seeds):
    together = identify(starts(env, layout_seeds, num_envs=3, seed=7, resets=3))
    config = resolve(env).replace(layout_seeds=layout_seeds)
    apart = SafetyGymEnv(config, num_envs=3, seed=7, num_threads=1)
    apart.reset()
    count = torch.zeros(3, dtype=torch.int64)
    for rows in ([2], [0], [2], [0, 1], [1]):
        mask = mask_of(*rows)
        count += mask
        apart.reset(TensorDict(_reset=mask.unsqueeze(-1), batch_size=[3]))
        now = identify(apart.get_state())
        assert now == [together[3 * number + row] for row, number in enumerate(count.tolist())]
