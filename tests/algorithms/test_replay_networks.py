"""Which environments the networks of off-policy algorithms are for."""

import pytest
import torch
from point_mass import PointMass
from run_configs import compose_config
from torchrl.data import Bounded, Unbounded

from safe_rl.algorithms import OffPolicy


def config_of(algo):
    """Three epochs of 4 x 40 steps, with a gradient step for 20 of them."""
    return compose_config(
        *("env=PointMass", f"algo={algo}", "frames=480", "num_envs=4", "frames_per_batch=160"),
        *("logger=none", "model.hidden_sizes=[16]", "memory.batch_size=32", "memory.n_steps=1"),
        "exploration.random_steps=160",
    )


class Acting(PointMass):
    """A point mass whose actions are said to be others."""

    def __init__(self, action_spec):
        super().__init__(action_spec.shape[0])
        self.action_spec = action_spec


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        (Unbounded((2, 2)), r"actions lie within bounds.*Unbounded"),
        (Bounded(-1, 1, (2, 2, 3)), r"the shape \[2, 3\]: policies act by vectors"),
    ],
)
def test_other_actions_than_vectors_within_bounds_are_refused(spec, message):
    with pytest.raises(ValueError, match=message):
        OffPolicy.build(config_of("sac"), Acting(spec))
