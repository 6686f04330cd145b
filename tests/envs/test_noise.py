"""Noise on the controls and on the number of substeps."""

import numpy as np
import pytest
import torch
from crafting import make
from scipy.stats import binom, chisquare, kstest, pearsonr

POINT = {"robot_base": "point", "task": "none", "observe_sensors": False, "observe_ctrl": True}
NUM_ENVS = 2000


def controls(env, action: tuple[float, float]) -> np.ndarray:
    """The controls that a step applies [N, 2]."""
    request = env.reset().set("action", torch.tensor(action).expand(env.batch_size[0], 2))
    return env.step(request)["next", "observation"].double().numpy()


def test_noise_is_added_to_the_clipped_control():
    got = controls(make({**POINT, "action_noise": 0.3}, NUM_ENVS), (0.2, 5.0))
    for column, mean in ((0, 0.2), (1, 1.0)):
        assert kstest((got[:, column] - mean) / 0.3, "norm").pvalue > 1e-3
    assert abs(pearsonr(got[:, 0], got[:, 1]).statistic) < 0.1


def test_noise_is_new_in_every_step_and_belongs_to_the_seed():
    env = make({**POINT, "action_noise": 0.1}, 50)
    tensordict, steps = env.reset(), []
    for _ in range(2):
        tensordict = env.step_mdp(env.step(tensordict.set("action", torch.zeros(50, 2))))
        steps.append(tensordict["observation"])
    assert not (steps[0] == steps[1]).any()
    again = make({**POINT, "action_noise": 0.1}, 50)
    assert np.array_equal(controls(again, (0.0, 0.0)), steps[0].double().numpy())
    other = make({**POINT, "action_noise": 0.1}, 50, seed=1)
    assert not np.array_equal(controls(other, (0.0, 0.0)), steps[0].double().numpy())


def substeps(env) -> np.ndarray:
    """Substeps of a step, by the time that passed; a substep of the Point takes 2 ms."""
    env.step(env.reset().set("action", torch.zeros(env.batch_size[0], 2)))
    return np.rint(env.get_state()["time"].numpy() / 0.002).astype(int)


@pytest.mark.parametrize(("trials", "probability"), [(10, 0.7), (4, 0.5)])
def test_substeps_are_binomial(trials, probability):
    got = substeps(
        make({**POINT, "frameskip_binom_n": trials, "frameskip_binom_p": probability}, NUM_ENVS)
    )
    counts = np.bincount(got, minlength=trials + 1)
    expected = NUM_ENVS * binom.pmf(np.arange(trials + 1), trials, probability)
    common = expected >= 5
    observed = [*counts[common], counts[~common].sum()]
    wanted = [*expected[common], expected[~common].sum()]
    if wanted[-1] == 0:
        observed, wanted = observed[:-1], wanted[:-1]
    assert chisquare(observed, wanted).pvalue > 1e-3


def test_worlds_with_fewer_substeps_and_gremlins_do_what_a_plain_world_does():
    gremlins = {"gremlins_num": 2, "frameskip_binom_n": 6, "frameskip_binom_p": 0.5}
    env = make({**POINT, **gremlins}, 12)
    env.rollout(3)
    before, action = env.get_state(), env.action_spec.rand()
    env.step(env.set_state(before).set("action", action))
    after = env.get_state()
    numbers = ((after["time"] - before["time"]) / 0.002).round().int()
    assert len(numbers.unique()) > 2
    for number in range(1, 7):
        plain = make({**POINT, "gremlins_num": 2, "frameskip_binom_n": number}, 12)
        plain.step(plain.set_state(before).set("action", action))
        rows = numbers == number
        got, want = after["qpos"][rows], plain.get_state()["qpos"][rows]
        torch.testing.assert_close(got, want, rtol=0, atol=1e-9)
