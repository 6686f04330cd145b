"""The options of the tests, and the length of episodes of the run that they evaluate."""

import pytest

from safe_rl.envs import OpenGLError, make_env
from safe_rl.evaluation.settings import EvaluationOptions

NUM_STEPS = 40


def options(**changes):
    return EvaluationOptions(**{"episodes": 7, "num_envs": 3, "num_threads": 1, **changes})


def skip_without_opengl():
    env = make_env("PointGoal0", seed=0, num_threads=1)
    env.reset()
    try:
        env.render(rows=0, width=16, height=16)
    except OpenGLError as error:
        pytest.skip(f"no pictures here: {error}")
