"""One step of every named environment beside a plain world that shares no code with it.

Most rows run into something. Contacts between boxes are chaotic: two correct worlds may part there.
So a row that does not agree to rounding has to be shown to be chaotic: the reference itself, set to
states that differ by 1e-12, must spread as widely.
"""

from dataclasses import dataclass, field

import numpy as np
import pytest
import torch
from crafting import after_random_steps, encounters
from reference import ReferenceWorld
from tensordict import TensorDict

from safe_rl.envs import SUITE, SafetyGymEnv, resolve

ROBOTS = ("Point", "Car", "Doggo")
NAMES = [*SUITE, *(f"{robot}{task}" for robot in ROBOTS for task in ("Run", "Circle"))]
NUM_ENVS, NUM_CALM = 40, 4
NUM_PERTURBED, PERTURBATION = 40, 1e-12
CHAOS = 10.0  # how far a chaotic row may be off, in units of the perturbed references' spread
MOST_CHAOTIC = 0.4  # share of the rows of an environment
POSITIONS = {"rtol": 0.0, "atol": 1e-11}
FLOAT32 = {"rtol": 1e-6, "atol": 1e-6}
EQUAL = {"rtol": 0.0, "atol": 0.0}
OF_STATE = ("qpos", "qvel", "qacc_warmstart", "time", "goal_pos")
OF_TASK = ("goal_button", "buttons_timer", "step_count")


@dataclass(frozen=True)
class Comparison:
    """One step from the same states; `expected` is the reference's, by row."""

    env: SafetyGymEnv
    state: TensorDict
    action: torch.Tensor
    got: TensorDict
    after: TensorDict
    expected: list[dict] = field(default_factory=list)
    spreads: dict[int, dict[str, float]] = field(default_factory=dict)

    def plain_step(self, world: ReferenceWorld, row: int, shift: float = 0.0, seed: int = 0):
        """One step of the reference from a row's state, moved by about `shift`."""
        state, after = self.state[row], self.after[row]
        values = {key: state[key].numpy().copy() for key in (*OF_STATE, *OF_TASK)}
        noise = np.random.default_rng(seed).standard_normal(values["qpos"].shape)
        values["qpos"] += shift * noise
        quat = state["target_quat"]
        world.set_state(
            **values,
            layout=dict(
                zip(("robot", *self.env.object_names), state["layout"].numpy(), strict=True)
            ),
            gremlin_yaws=(2 * torch.atan2(quat[:, 3], quat[:, 0])).tolist(),
            start_pose=state["start_pose"].numpy(),
        )
        result = world.step(self.action[row].numpy())
        if result["goal_met"]:
            # The next goal is drawn at random, so it is taken from the other side.
            world.set_goal(after["goal_pos"].numpy(), int(after["goal_button"]))
        return result | {
            "buttons_timer": world.buttons_timer,
            "observation": world.observe(),
        }

    def spread(self, row: int, key: str) -> float:
        """How far the reference's own outcomes lie apart from states that are almost the same."""
        if row not in self.spreads:
            world = ReferenceWorld(self.env.config.to_dict())
            outcomes = [self.expected[row]] + [
                self.plain_step(world, row, PERTURBATION, seed) for seed in range(NUM_PERTURBED)
            ]
            self.spreads[row] = {
                key: np.ptp(np.array([outcome[key] for outcome in outcomes], float), axis=0).max()
                for key in outcomes[0]
            }
        return self.spreads[row][key]

    def want(self, key: str) -> np.ndarray:
        """The reference's values [N, n]."""
        values = np.array([result[key] for result in self.expected], dtype=np.float64)
        return values.reshape(len(values), -1)

    def agree(self, got: torch.Tensor, key: str, rtol: float, atol: float) -> np.ndarray:
        """Assert that all rows agree, chaotic ones as far as they can; returns those that do."""
        want = self.want(key)
        error = np.abs(got.numpy().reshape(want.shape).astype(np.float64) - want)
        agrees = (error <= atol + rtol * np.abs(want)).all(1)
        for row in np.flatnonzero(~agrees):
            spread = self.spread(row, key)
            assert error[row].max() <= CHAOS * spread, f"row {row}, {key}: spread {spread:.1e}"
        assert (~agrees).mean() <= MOST_CHAOTIC
        return agrees


def compare(env: SafetyGymEnv, state: TensorDict, action: torch.Tensor, got: TensorDict):
    """Take the same step with the reference in every row."""
    case = Comparison(env, state, action.double(), got, env.get_state())
    world = ReferenceWorld(env.config.to_dict())
    case.expected.extend(case.plain_step(world, row) for row in range(len(state)))
    return case


@pytest.fixture(params=NAMES, scope="module")
def case(request) -> Comparison:
    """One step from states full of encounters, costs as magnitudes."""
    torch.manual_seed(1)
    config = resolve(request.param).replace(constrain_indicator=False)
    env = SafetyGymEnv(config, num_envs=NUM_ENVS, seed=1, sleep=False, num_threads=1)
    state = encounters(env, NUM_CALM)
    action = 1.3 * env.action_spec.rand()
    got = env.step(env.set_state(state).set("action", action))["next"]
    return compare(env, state, action, got)


def test_states_agree(case):
    case.agree(case.after["qpos"], "qpos", **POSITIONS)
    case.agree(case.after["time"], "time", **POSITIONS)
    for key in ("buttons_timer", "step_count"):
        case.agree(case.after[key], key, **EQUAL)


def test_observations_agree(case):
    case.agree(case.got["observation"], "observation", **FLOAT32)


def test_rewards_and_ends_agree(case):
    case.agree(case.got["reward"], "reward", **FLOAT32)
    for key in ("goal_met", "terminated", "truncated"):
        case.agree(case.got[key], key, **EQUAL)
    if case.env.config.task in ("goal", "button", "push"):
        assert case.want("goal_met").any(), "no new goal was compared"


def test_costs_agree_and_all_occur(case):
    keys = [key for key in case.expected[0] if key.startswith("cost")]
    assert sorted(case.env.cost_keys) == sorted(keys)
    for key in keys:
        agrees = case.agree(case.got[key], key, **FLOAT32)
        occurs = case.want(key)[agrees] > 0
        possible = key != "cost_exception" and len(keys) > 2
        assert occurs.any() == possible, f"{key} never occurs, so nothing was compared"
        assert not occurs.all()


@pytest.mark.parametrize("name", [name for name in SUITE if name[-1] != "0"])
def test_indicator_is_one_where_a_cost_is_positive(name):
    torch.manual_seed(2)
    magnitudes = SUITE[name].replace(constrain_indicator=False)
    options = {"num_envs": 24, "seed": 2, "sleep": False, "num_threads": 1}
    env, raw = SafetyGymEnv(name, **options), SafetyGymEnv(magnitudes, **options)
    state, action = encounters(env, NUM_CALM), env.action_spec.rand()
    got = env.step(env.set_state(state).set("action", action))["next"]
    want = raw.step(raw.set_state(state).set("action", action))["next"]
    for key in env.cost_keys:
        torch.testing.assert_close(got[key], (want[key] > 0).float(), rtol=0, atol=0)
    assert 0 < got["cost"].mean() < 1


@pytest.mark.parametrize("name", ["PointGoal2", "CarPush2", "DoggoGoal2", "PointButton2"])
def test_sleeping_objects_change_nothing_visible(name):
    """Objects have come to rest and sleep; the reference knows no sleep."""
    torch.manual_seed(3)
    env = SafetyGymEnv(name, num_envs=16, seed=3, num_threads=1)
    state = after_random_steps(env, num_steps=60)
    action = env.action_spec.rand()
    got = env.step(TensorDict({"action": action}, batch_size=[16]))["next"]
    case = compare(env, state, action, got)
    case.agree(case.after["qpos"], "qpos", rtol=0, atol=1e-5)
    case.agree(got["reward"], "reward", rtol=0, atol=1e-5)
    case.agree(got["observation"], "observation", rtol=0, atol=1e-3)
    for key in env.cost_keys:
        case.agree(got[key], key, **EQUAL)
