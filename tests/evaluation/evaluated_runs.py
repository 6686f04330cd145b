"""A small run to evaluate, and the options of the tests."""

import pytest
from omegaconf import OmegaConf
from run_configs import compose_config

from safe_rl.envs import OpenGLError, make_env
from safe_rl.evaluation.settings import EvaluationOptions
from safe_rl.training.building import build_trainer, seed_everything

NUM_STEPS = 40


def train(directory, *overrides):
    """A run of two epochs on PointGoal1 with short episodes."""
    config = compose_config(
        "env=PointGoal1",
        f"env.num_steps={NUM_STEPS}",
        "frames=320",
        "num_envs=4",
        "frames_per_batch=160",
        "model.hidden_sizes=[16]",
        "policy_update.minibatch_size=80",
        "critic_update.minibatch_size=80",
        "logger=none",
        *overrides,
    )
    seed_everything(config.seed, num_threads=1)
    node = OmegaConf.to_container(config.env, resolve=True)
    env = make_env(node, num_envs=4, seed=config.seed, num_threads=1)
    build_trainer(config, env, directory).run()
    return directory


def options(**changes):
    return EvaluationOptions(**{"episodes": 7, "num_envs": 3, "num_threads": 1, **changes})


def skip_without_opengl():
    env = make_env("PointGoal0", seed=0, num_threads=1)
    env.reset()
    try:
        env.render(rows=0, width=16, height=16)
    except OpenGLError as error:
        pytest.skip(f"no pictures here: {error}")
