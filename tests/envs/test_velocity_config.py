"""Configurations of the velocity family: what is accepted, and what people are told otherwise."""

import inspect
import math

import gymnasium
import pytest

from safe_rl.envs.keys import ConfigError
from safe_rl.envs.physics.dynamics import SCALES
from safe_rl.envs.velocity import VELOCITY_SUITE, resolve_velocity
from safe_rl.envs.velocity.velocity_config import RUNNERS

OURS = {"robot", "velocity_threshold", "num_steps", "physics", "physics_buffers", *SCALES}
THEIRS = {"xml_file", "default_camera_config", "main_body", "kwargs", "self"}


@pytest.mark.parametrize("name", VELOCITY_SUITE)
def test_keys_and_defaults_are_gymnasiums(name):
    config = resolve_velocity(name)
    made = gymnasium.make(RUNNERS[config.robot].gymnasium_id).unwrapped
    parameters = inspect.signature(type(made).__init__).parameters
    defaults = {key: row.default for key, row in parameters.items() if key not in THEIRS}
    ours = {key: value for key, value in config.to_dict().items() if key not in OURS}
    assert ours == defaults


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("SafeHoperVelocity", "Did you mean 'SafeHopperVelocity'"),
        ({"frame_skip": 2}, "'robot' must be one of"),
        ({"robot": "hoper"}, "Did you mean 'hopper'"),
        ({"robot": "hopper", "velocity_treshold": 1.0}, "Did you mean 'velocity_threshold'"),
        ({"robot": "swimmer", "healthy_reward": 1.0}, "'swimmer' has no key"),
        ({"robot": "hopper", "frame_skip": 0}, "frame_skip=0: it must be greater"),
        ({"robot": "hopper", "healthy_reward": math.inf}, "must be a finite number"),
        ({"robot": "hopper", "healthy_z_range": [2.0, 1.0]}, "lowest <= highest"),
    ],
)
def test_mistakes_are_named(given, message):
    with pytest.raises(ConfigError, match=message):
        resolve_velocity(given)
