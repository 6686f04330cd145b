"""Layouts that are drawn ahead are the ones that would have been drawn when they are needed."""

import pytest
import torch
from tensordict import TensorDict

from safe_rl.envs import SafetyGymEnv
from safe_rl.envs.safety_gym.draws import LayoutsAhead
from safe_rl.envs.safety_gym.layouts import LayoutError
from safe_rl.envs.safety_gym.suite import resolve


class Drawing:
    """Layouts [B, 1, 2] that hold their key; none for keys above 100."""

    def __init__(self):
        self.asked = []

    def __call__(self, key):
        self.asked.append(key.tolist())
        if (key > 100).any():
            raise LayoutError("'hazard0' did not fit.")
        return key.view(-1, 1, 1).expand(-1, 1, 2).double()


def mask_of(*rows):
    return torch.isin(torch.arange(3), torch.tensor(rows))


def test_rows_that_begin_one_by_one_are_drawn_together():
    draw = Drawing()
    layouts = LayoutsAhead(draw, num_envs=3, num_columns=1)
    episode = torch.zeros(3, dtype=torch.int64)
    for rows in ([0, 1, 2], [1], [0], [2], [1], [2], [0], [2], [2]):
        mask = mask_of(*rows)
        episode += mask
        key = 10 * torch.arange(3) + episode
        assert layouts(key, key + 1, mask)[mask, 0, 0].tolist() == key[mask].tolist()
    # all at first, and whenever one is not known yet; in the end the others' next ones are
    assert draw.asked == [[1, 11, 21], [2, 12, 22], [3, 13, 23], [4, 14, 24], [25]]


def test_an_episode_that_may_never_come_has_no_say():
    draw = Drawing()
    layouts = LayoutsAhead(draw, num_envs=3, num_columns=1)
    key = torch.tensor([1, 2, 3])
    assert layouts(key, torch.tensor([4, 5, 500]), mask_of(0))[0].tolist() == [[1, 1]]
    assert layouts(key, key, mask_of(1))[1].tolist() == [[2, 2]]
    with pytest.raises(LayoutError, match="hazard0"):
        layouts(torch.tensor([6, 7, 500]), key, mask_of(2))
    assert layouts(key, key, mask_of(2))[2].tolist() == [[3, 3]]


@pytest.mark.parametrize("env", ["PointGoal1", "PointButton2", "PointPush2"])
@pytest.mark.parametrize("layout_seeds", [None, 5])
def test_episodes_are_the_same_whenever_rows_begin_them(env, layout_seeds):
    config = resolve(env).replace(layout_seeds=layout_seeds)
    together, apart = (SafetyGymEnv(config, num_envs=3, seed=7, num_threads=1) for _ in range(2))
    positions = {}
    for number in (1, 2, 3):
        together.reset()
        positions[number] = together.get_state()["layout"]
    apart.reset()
    count = torch.ones(3, dtype=torch.int64)
    for rows in ([2], [0], [2], [0, 1], [1]):
        mask = mask_of(*rows)
        count += mask
        apart.reset(TensorDict(_reset=mask.unsqueeze(-1), batch_size=[3]))
        state = apart.get_state()["layout"]
        for row in rows:
            assert state[row].equal(positions[int(count[row])][row])
