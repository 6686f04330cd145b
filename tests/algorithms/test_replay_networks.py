"""Which environments the networks of off-policy algorithms are for."""

import pytest
import torch
from point_mass import PointMass
from run_configs import off_policy_config
from torchrl.data import Bounded, Composite, Unbounded

from safe_rl.algorithms import OffPolicy
from safe_rl.runs.table import read_table
from safe_rl.training.building import build_trainer


class Acting(PointMass):
    """A point mass whose actions are said to be others."""

    def __init__(self, action_spec):
        super().__init__(action_spec.shape[0])
        self.action_spec = action_spec


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        (Unbounded((2, 2)), r"actions within bounds.*Unbounded"),
        (Bounded(-1, 1, (2, 2, 3)), r"the shape \[2, 3\]: policies act by vectors"),
    ],
)
def test_other_actions_than_vectors_within_bounds_are_refused(spec, message):
    with pytest.raises(ValueError, match=message):
        OffPolicy.from_config(off_policy_config("algo=sac"), Acting(spec))


@pytest.mark.parametrize(
    ("observation", "message"),
    [
        (Composite(b=Unbounded((2, 3)), a=Unbounded((2, 4)), shape=[2]), r"a \[4\], b \[3\]: make"),
        (Composite(a=Unbounded((2, 4)), shape=[2]), r"observes a \[4\]: make"),
        (Unbounded((2, 9, 9, 3), dtype=torch.uint8), r"observes observation \[9, 9, 3\]: make"),
    ],
)
def test_other_observations_than_a_vector_are_refused(observation, message):
    env = PointMass(2)
    env.observation_spec = Composite(observation=observation, shape=[2])
    with pytest.raises(ValueError, match=message):
        OffPolicy.from_config(off_policy_config("algo=sac"), env)


@pytest.mark.parametrize("algo", ["sac_lagrangian", "td3_lagrangian"])
def test_bounds_of_double_precision_are_for_networks_of_single_precision(algo, tmp_path):
    env = Acting(Bounded(-1, 1, (4, 2), dtype=torch.float64))
    trainer = build_trainer(off_policy_config(f"algo={algo}", "frames=480"), env, tmp_path)
    trainer.run()
    assert read_table(tmp_path / "progress.csv")["policy_num_updates"] == [8, 8, 8]
    assert trainer.algorithm.policy(env.reset())["action"].dtype == torch.float32
