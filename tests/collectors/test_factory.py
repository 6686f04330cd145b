"""The collector factory on the point mass."""

import pytest
from point_mass import PointMass
from torchrl.modules import RandomPolicy

from safe_rl.collectors import make_collector


def test_steps_have_no_ids_of_trajectories():
    env = PointMass(3)
    batch = next(iter(make_collector(env, RandomPolicy(env.action_spec), frames_per_batch=30)))
    assert batch.shape == (3, 10)
    assert "collector" not in batch.keys()  # noqa: SIM118, a TensorDict is not a mapping


@pytest.mark.parametrize(("frames", "told"), [(10, "use 9 or 12"), (2, "use 3,")])
def test_frames_must_be_shared_equally(frames, told):
    with pytest.raises(ValueError, match=told):
        make_collector(PointMass(3), None, frames_per_batch=frames)
