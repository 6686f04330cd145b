"""The collector factory on the point mass."""

import pytest
import torch
from point_mass import PointMass

from safe_rl.collectors import make_collector
from safe_rl.models import BehaviourPolicy, make_actor


def make_policy():
    torch.manual_seed(0)
    return BehaviourPolicy(make_actor(4, 2, hidden_sizes=[8], initial_log_std=-0.5))


def test_batches_are_consecutive_rollouts_with_all_the_keys_of_the_policy():
    env = PointMass(num_envs=3, num_steps=7)
    batches = iter(make_collector(env, make_policy(), frames_per_batch=30))
    first, second = next(batches), next(batches)
    assert first.shape == (3, 10)
    assert {"loc", "scale", "action", "action_log_prob"} <= set(first.keys())
    assert "collector" not in first.keys()  # noqa: SIM118, a TensorDict is not a mapping
    joined = torch.cat([first, second], 1)
    going_on = ~joined["next", "done"][:, :-1].squeeze(-1)
    torch.testing.assert_close(
        joined["next", "observation"][:, :-1][going_on], joined["observation"][:, 1:][going_on]
    )
    assert joined["next", "done"].sum() == 3 * (20 // 7)


def test_frames_must_be_shared_equally():
    with pytest.raises(ValueError, match="use 9 or 12"):
        make_collector(PointMass(3), make_policy(), frames_per_batch=10)
    with pytest.raises(ValueError, match="use 3,"):
        make_collector(PointMass(3), make_policy(), frames_per_batch=2)
