"""Which environments the networks of off-policy algorithms are for."""

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium_envs import Walk
from point_mass import PointMass
from run_configs import off_policy_config
from torchrl.data import Bounded, Unbounded

from safe_rl.algorithms import OffPolicy
from safe_rl.envs import from_gymnasium
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


class Seen(Walk):
    """A bright column of a picture is where the point is; its speed is a number beside it."""

    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)
    observation_space = gymnasium.spaces.Dict(
        picture=gymnasium.spaces.Box(0, 255, (36, 36, 3), np.uint8),
        speed=gymnasium.spaces.Box(-9.0, 9.0, (1,), np.float32),
    )

    def _observe(self):
        picture = np.zeros((36, 36, 3), np.uint8)
        picture[:, int(18 + 8 * self.place)] = 255
        return {"picture": picture, "speed": np.array([self.speed], np.float32)}

    def step(self, action):
        self.speed = float(action[0])
        self.place = np.clip(self.place + 0.2 * self.speed, -2, 2)
        return self._observe(), self.speed, False, False, {"cost": float(self.place > 0)}


@pytest.mark.parametrize(
    "algo",
    [
        "sac_lagrangian",
        *(pytest.param(a, marks=pytest.mark.long) for a in ("td3_lagrangian", "wcsac")),
    ],
)
def test_pictures_and_numbers_beside_them_are_learned_from(algo, tmp_path):
    env = from_gymnasium(Seen, num_envs=4, num_steps=20, flatten=False, seed=0)
    steps = ("memory.n_steps=3", "memory.capacity=1000")
    config = off_policy_config(f"algo={algo}", "model=cnn", "frames=480", *steps)
    trainer = build_trainer(config, env, tmp_path)
    networks = trainer.algorithm.networks
    before = {name: [p.clone() for p in net.parameters()] for name, net in networks.items()}
    trainer.run()
    for name, network in networks.items():
        assert sum("encoder" in key for key, _ in network.named_parameters()) == 6, name
        pairs = zip(before[name], network.parameters(), strict=True)
        assert not any(torch.equal(old, new) for old, new in pairs), name


def test_pictures_are_stored_with_those_three_steps_later():
    env = from_gymnasium(Seen, num_envs=2, num_steps=20, flatten=False, seed=0)
    config = off_policy_config("algo=sac", "model=cnn", "memory.n_steps=3", "memory.capacity=1000")
    memory = OffPolicy.from_config(config, env).replay_buffer
    steps = env.rollout(8, policy=lambda step: step.set("action", torch.ones(2, 1)))
    memory.extend(steps)
    batch = next(iter(memory.minibatches(1)))
    here, after = batch["observation", "picture"], batch["next", "observation", "picture"]
    assert here.dtype == torch.uint8
    first, then = (picture[:, 0, :, 0].int().argmax(1) for picture in (here, after))
    # by 1.6 columns in each step
    assert set((then - first)[first < 28].tolist()) <= {4, 5}


@pytest.mark.parametrize("algo", ["sac_lagrangian", "td3_lagrangian"])
def test_bounds_of_double_precision_are_for_networks_of_single_precision(algo, tmp_path):
    env = Acting(Bounded(-1, 1, (4, 2), dtype=torch.float64))
    trainer = build_trainer(off_policy_config(f"algo={algo}", "frames=480"), env, tmp_path)
    trainer.run()
    assert read_table(tmp_path / "progress.csv")["policy_num_updates"] == [8, 8, 8]
    assert trainer.algorithm.policy(env.reset())["action"].dtype == torch.float32
