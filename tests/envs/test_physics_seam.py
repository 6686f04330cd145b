"""A step on any backend: on its device, in its numbers, and without waiting for it."""

import pytest
import torch
from looking import no_looks

from safe_rl.envs import SafetyGymEnv
from safe_rl.envs.physics import OUTPUTS, STATE, BatchPhysics, Physics
from safe_rl.envs.velocity import VelocityEnv

EVERYTHING = {
    **{"robot_base": "point", "task": "goal", "goal_size": 3.0, "action_noise": 0.1},
    **{"hazards_num": 3, "vases_num": 2, "gremlins_num": 2, "pillars_num": 1, "buttons_num": 2},
    **{f"constrain_{kind}": True for kind in ("hazards", "vases", "gremlins", "pillars")},
    **{f"observe_{kind}": True for kind in ("hazards", "vases", "gremlins", "pillars", "qpos")},
    **{"observe_goal_lidar": True, "observe_remaining": True, "vases_displace_cost": 1.0},
    **{"constrain_boundary": True, "boundary_x": 0.5, "frameskip_binom_p": 0.9},
    **{"constrain_buttons": True, "constrain_velocity": True, "velocity_limit": 0.1},
}
# those of the last stage are the backend's own affair
WITHOUT_FORCES = {"contact_cost_weight": 0.0, "include_cfrc_ext_in_observation": False}
CASES = {
    "everything": EVERYTHING,
    "natural lidar": {**EVERYTHING, "lidar_type": "natural"},
    "errors": {**EVERYTHING, "terminate_resample_failure": False},
    **{name: name for name in ("PointGoal1", "CarButton2", "CarPush2", "DoggoRun1", "CarCircle2")},
    **{name: name for name in ("SafeHopperVelocity", "SafeSwimmerVelocity")},
    "SafeHumanoidVelocity": {"robot": "humanoid", **WITHOUT_FORCES},
}


class WaitingPhysics(Physics):
    """A backend of another type of numbers, where the host would wait to read a value."""

    device, waits = torch.device("cpu"), True

    def __init__(self, model, num_envs, dtype, outputs):
        self.dtype, self._batch = dtype, BatchPhysics(model, num_envs, 1, {*OUTPUTS, *outputs})
        self.timestep, self.actuator_state = self._batch.timestep, self._batch.actuator_state
        self.inside = False
        for name in STATE:
            setattr(self, name, getattr(self._batch, name).to(dtype, copy=True))
        self.outputs = {name: out.to(dtype, copy=True) for name, out in self._batch.outputs.items()}

    def _call(self, method, *arguments):
        self.inside = True
        for name in STATE:
            getattr(self._batch, name).copy_(getattr(self, name))
        result = getattr(self._batch, method)(*arguments)
        for name in STATE:
            getattr(self, name).copy_(getattr(self._batch, name))
        for name, output in self.outputs.items():
            output.copy_(self._batch.outputs[name])
        self.inside = False
        return result

    def reset(self, mask):
        return self._call("reset", mask)

    def forward(self, mask=None):
        return self._call("forward", mask)

    def step(self, num_substeps, mocap_path=None, counts=None, refresh=True):
        path = None if mocap_path is None else mocap_path.double()
        return self._call("step", num_substeps, path, counts, refresh)

    def rays(self, origin, directions, group, exclude_body):
        distance = self._call("rays", origin.double(), directions.double(), group, exclude_body)
        return distance.to(self.dtype)

    def check(self, wrong, error): ...


def make(case, dtype=None):
    """With a type, on the backend that waits."""
    family = VelocityEnv if case.endswith("Velocity") else SafetyGymEnv

    class Waiting(family):
        def _make_physics(self, model, bodies, num_threads, outputs=OUTPUTS):
            return WaitingPhysics(model, self.batch_size[0], dtype, outputs)

    return (Waiting if dtype else family)(CASES[case], num_envs=3, seed=1)


def rollouts(*envs, steps, monkeypatch):
    """Steps of environments under the same actions; on `WaitingPhysics` they read no value."""
    states = [env.reset() for env in envs]
    torch.manual_seed(0)
    for _ in range(steps):
        action = envs[0].action_spec.rand()
        for number, env in enumerate(envs):
            states[number].set("action", action)
            if isinstance(env._physics, WaitingPhysics):
                with no_looks(env._physics, monkeypatch) as mode:
                    following = env._step(states[number])
                assert mode.num_calls > 10
            else:
                following = env._step(states[number])
            states[number] = following
        yield states


@pytest.mark.parametrize("case", CASES)
def test_a_step_looks_at_nothing_and_gives_the_same_numbers(case, monkeypatch):
    envs, met = (make(case), make(case, torch.float64)), 0
    for looking, not_looking in rollouts(*envs, steps=12, monkeypatch=monkeypatch):
        assert looking.keys() == not_looking.keys()
        for key, value in looking.items():
            assert torch.equal(value, not_looking[key]), key
        met += int(looking.get("goal_met", torch.zeros(1)).sum())
    assert (met > 0) == (case in ("everything", "natural lidar", "errors"))


@pytest.mark.parametrize("case", ["everything", "CarButton2", "CarPush2"])
def test_a_step_may_be_computed_in_single_precision(case, monkeypatch):
    exact, rough = make(case), make(case, torch.float32)
    for double, single in rollouts(exact, rough, steps=3, monkeypatch=monkeypatch):
        for key, value in double.items():
            if key != "observation":
                torch.testing.assert_close(value, single[key], atol=1e-3, rtol=1e-3)
    assert rough.get_state()["qpos"].dtype is torch.float32
