"""Scaled dynamics against models that MuJoCo compiles; noise on controls and substeps."""

import mujoco
import numpy as np
import pytest
import torch
from crafting import make
from scipy.stats import binom, chisquare, kstest, pearsonr

from safe_rl.envs import ConfigError, SafetyGymEnv, make_env
from safe_rl.envs.physics.dynamics import SCALES, scale_dynamics
from safe_rl.envs.safety_gym.config import ROBOTS
from safe_rl.envs.velocity.runner import ASSETS
from safe_rl.envs.velocity.velocity_config import RUNNERS

FILES = {name: str(path) for name, path in ROBOTS.items()} | {
    name: str(ASSETS / row.mjcf) for name, row in RUNNERS.items()
}


def heavier(spec, factor):
    for geom in spec.geoms:
        geom.density *= factor
        geom.mass *= factor  # NaN where the density says it
    if spec.compiler.settotalmass > 0:
        spec.compiler.settotalmass *= factor


def rougher(spec, factor):
    for geom in spec.geoms:
        geom.friction *= factor


def stiffer(spec, factor):
    for joint in spec.joints:
        joint.damping *= factor


def stronger(spec, factor):
    for actuator in spec.actuators:
        for name in ("gainprm", "biasprm", "forcerange"):
            setattr(actuator, name, getattr(actuator, name) * factor)


IN_THE_FILE = dict(zip(SCALES, (heavier, rougher, stiffer, stronger), strict=True))


def numbers_of(model):
    """Every array of a model but those of pictures and of its extent."""
    names = [n for n in dir(model) if n.partition("_")[0] in
             ("body", "dof", "jnt", "geom", "actuator", "tendon", "eq", "qpos0")]  # fmt: skip
    found = {name: getattr(model, name) for name in names}
    return {name: value for name, value in found.items() if isinstance(value, np.ndarray)}


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("robot", FILES)
def test_the_model_is_the_one_that_is_compiled_from_multiplied_numbers(robot, scale):
    spec = mujoco.MjSpec.from_file(FILES[robot])
    scaled = spec.compile()
    scale_dynamics(scaled, {scale: 1.7}, slice(1, scaled.nbody))
    spec = mujoco.MjSpec.from_file(FILES[robot])
    IN_THE_FILE[scale](spec, 1.7)
    compiled = spec.compile()
    for name, value in numbers_of(compiled).items():
        np.testing.assert_allclose(numbers_of(scaled)[name], value, rtol=1e-9, err_msg=name)
    assert scaled.stat.meaninertia == pytest.approx(compiled.stat.meaninertia)


SCALED = {"mass_scale": 1e3, "friction_scale": 0.01, "damping_scale": 100.0, "strength_scale": 0.0}


@pytest.mark.parametrize("key", [None, *SCALED])
def test_a_car_goes_nowhere_heavy_stiff_and_without_friction_or_strength(key):
    keys = {key: SCALED[key]} if key else {}
    env = SafetyGymEnv({"robot_base": "car", "task": "x", **keys}, 1, seed=0, num_threads=1)
    env.reset()
    start = env.get_state()
    forwards = lambda td: td.set("action", torch.full((1, 2), 0.7))  # noqa: E731
    env.rollout(50, forwards, auto_reset=False, tensordict=env.set_state(start))
    way = (env.get_state()["qpos"] - start["qpos"])[:, :2].norm().item()
    assert way < 0.06 if key else way > 0.3


def test_muscles_have_no_strength_to_multiply(tmp_path):
    servo = '<velocity name="z" gear=".3 0 0 0 0 0" jointinparent="z" kv="1"/>'
    muscle = '<muscle name="z" joint="z" lengthrange="0 1" ctrlrange="0 1"/>'
    wheel = ROBOTS["point"].read_text().replace(servo, muscle)
    assert muscle in wheel
    (tmp_path / "arm.xml").write_text(wheel)
    keys = {"robot_base": str(tmp_path / "arm.xml")}
    SafetyGymEnv({**keys, "mass_scale": 2.0}, 1)
    with pytest.raises(ConfigError, match="'strength_scale' is for actuators"):
        SafetyGymEnv({**keys, "strength_scale": 2.0}, 1)


RANGES = {
    "mass_scale": (0.5, 2.0),
    "friction_scale": (0.5, 1.5),
    "damping_scale": (0.5, 2.0),
    "strength_scale": (0.7, 1.3),
}


def observations(env, state, actions):
    env.set_state(state)
    steps = [env.step(state.empty().set("action", action)) for action in actions]
    return torch.stack([step["next", "observation"] for step in steps])


@pytest.mark.parametrize("name", ["CarGoal1", "DoggoGoal1", "SafeAntVelocity"])
def test_a_world_with_drawn_factors_moves_as_an_environment_with_these_factors(name):
    drawn = make_env(name, num_envs=3, seed=0, **RANGES)
    drawn.reset()
    state = drawn.get_state()
    actions = 2 * torch.rand(10, *drawn.action_spec.shape) - 1
    moved = observations(drawn, state, actions)
    for row, factors in enumerate(state["dynamics"].tolist()):
        one = make_env(name, num_envs=1, seed=0, **dict(zip(RANGES, factors, strict=True)))
        alone = observations(one, state[row : row + 1].exclude("dynamics"), actions[:, row, None])
        assert torch.equal(alone[:, 0], moved[:, row])
    as_it_was = make_env(name, num_envs=3, seed=0)
    assert not torch.equal(observations(as_it_was, state.exclude("dynamics"), actions), moved)


def test_every_episode_draws_its_factors_within_their_ranges_whatever_the_number_of_worlds():
    keys = {**RANGES, "num_steps": 2}
    env, fewer = (make_env("CarGoal1", num_envs=number, seed=3, **keys) for number in (50, 2))
    episodes = []
    for _ in range(3):
        for each in (env, fewer):
            each.reset()
        episodes.append(env.get_state()["dynamics"])
        assert torch.equal(episodes[-1][:2], fewer.get_state()["dynamics"])
    low, high = torch.tensor([*RANGES.values()], dtype=torch.float64).T
    factors = torch.cat(episodes)
    assert len(factors.unique(dim=0)) == len(factors)
    assert ((factors >= low) & (factors <= high)).all()
    mean, std = (low + high) / 2, (high - low) / 12**0.5
    assert ((factors.mean(0) - mean).abs() < 4 * std / len(factors) ** 0.5).all()
    assert (factors.std(0) / std - 1).abs().max() < 0.15


def test_a_range_that_cannot_be_drawn_from_is_refused():
    with pytest.raises(ConfigError, match="'mass_scale' is a range, which 'physics' warp"):
        make_env("PointGoal1", mass_scale=[0.5, 2.0], physics="warp")
    with pytest.raises(ConfigError, match="a factor, or the lowest and the highest one"):
        make_env("PointGoal1", mass_scale=[2.0, 0.5])
    env = make_env("PointGoal1", mass_scale=[0.5, 2.0])
    env.reset()
    state = env.get_state()
    state["dynamics"] = torch.ones(1, 2)
    with pytest.raises(ValueError, match="State 'dynamics' must have shape"):
        env.set_state(state)


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


def test_noise_is_new_in_every_row_and_step_and_with_every_seed():
    nothing, drawn = torch.zeros(50, 2), []
    for seed in (0, 1):
        env = make({**POINT, "action_noise": 0.1}, 50, seed=seed)
        steps = env.rollout(2, lambda td: td.set("action", nothing))["next", "observation"]
        drawn.append(steps.flatten(0, 1))
    assert len(torch.cat(drawn).unique(dim=0)) == 2 * 50 * 2


def test_substeps_are_binomial():
    env = make({**POINT, "frameskip_binom_n": 4, "frameskip_binom_p": 0.7}, NUM_ENVS)
    env.step(env.reset().set("action", torch.zeros(NUM_ENVS, 2)))
    # a substep of the Point takes 2 ms
    counts = np.bincount(np.rint(env.get_state()["time"].numpy() / 0.002).astype(int), minlength=5)
    assert chisquare(counts, NUM_ENVS * binom.pmf(np.arange(5), 4, 0.7)).pvalue > 1e-3


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
