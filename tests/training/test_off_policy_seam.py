"""An algorithm of another kind runs in the same loop, which knows nothing of it: training,
checkpoints, resuming, transfer and evaluation are those of every run.
"""

import pytest
import torch
from point_mass import PointMass
from point_mass_runs import trainer_of
from run_configs import assert_resumes_exactly, point_mass_config
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.modules import RandomPolicy

from safe_rl.algorithms import Algorithm
from safe_rl.checks import SettingError
from safe_rl.evaluation.episodes import collect_episodes
from safe_rl.evaluation.loading import load_policy
from safe_rl.runs.run import Run
from safe_rl.runs.table import read_table
from safe_rl.training.building import begin_from
from safe_rl.trust import allow

pytestmark = pytest.mark.long


class RandomExploration(TensorDictModuleBase):
    """Acts at random, and has a network that evaluation has to find in the checkpoint."""

    def __init__(self, env):
        super().__init__()
        self.bias = nn.Parameter(torch.zeros(env.action_spec.shape[-1]))
        self._random = RandomPolicy(env.action_spec)
        self.in_keys, self.out_keys = ["observation"], ["action"]

    def forward(self, tensordict):
        self._random(tensordict)
        tensordict["action"] = tensordict["action"] + self.bias.detach()
        return tensordict


class Drifting(Algorithm):
    """Moves its policy a little after every batch, and keeps them in a replay buffer."""

    cost_keys = ()

    def __init__(self, env):
        self.policy = RandomExploration(env)
        self.networks = {"explorer": self.policy}
        self._buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(2000), batch_size=64)

    @classmethod
    def from_config(cls, config, env):
        return cls(env)

    @classmethod
    def build_policy(cls, config, env, device):
        policy = RandomExploration(env)
        return policy, {"explorer": policy}

    def learn(self, batch, episodes):
        self._buffer.extend(batch.reshape(-1))
        with torch.no_grad():
            self.policy.bias += 0.01
        return {"sampled_reward": self._buffer.sample()["next", "reward"].mean().item()}

    def checkpoint_components(self):
        return {**self.networks, "buffer": self._buffer}


@pytest.fixture
def make_trainer(tmp_path):
    allow(__name__)
    (tmp_path / "algo").mkdir()
    (tmp_path / "algo" / "mine.yaml").write_text(
        "# @package _global_\nalgo: {name: mine, _target_: test_off_policy_seam.Drifting}\n"
        "model: {hidden_sizes: [8]}\ncritic_update: {minibatch_size: 1, num_passes: 1}\n"
    )

    def make(name, *overrides):
        config = point_mass_config(
            f"hydra.searchpath=[file://{tmp_path}]",
            *("algo=mine", "cost_limits={}"),
            *overrides,
            minibatch_size=None,
        )
        return trainer_of(config, tmp_path / name)

    return make


def test_its_run_is_written_transferred_and_evaluated(make_trainer, tmp_path):
    trainer = make_trainer("run", "checkpoint.interval=0")
    line = trainer.run()
    table = read_table(tmp_path / "run" / "progress.csv")
    assert table["steps"] == [160 * epoch for epoch in range(1, 9)]
    assert len(set(table["sampled_reward"])) == 8
    assert "cost" in line
    second = make_trainer("second", "seed=1")
    taken = begin_from(second.algorithm, {"init_from": tmp_path / "run"})
    assert taken == ["explorer"]
    assert torch.equal(second.algorithm.policy.bias, trainer.algorithm.policy.bias)
    config, env = Run(tmp_path / "run").config, PointMass(2, 20)
    checkpoint = Run(tmp_path / "run").find_checkpoint("last")
    policy = load_policy(config, env, checkpoint, torch.device("cpu"))
    assert policy.bias.tolist() == pytest.approx([0.08, 0.08])
    episodes = collect_episodes(env, policy, 3, env.cost_keys, deterministic=False)
    assert episodes.lengths.tolist() == [20, 20, 20]


def test_a_column_that_training_measures_is_not_replaced(make_trainer, monkeypatch):
    monkeypatch.setattr(Drifting, "learn", lambda self, *_: {"episode_cost": -7.0})
    with pytest.raises(SettingError, match="'learn' returned episode_cost, which training"):
        make_trainer("run").run()


def test_it_resumes_with_its_buffer_as_if_it_had_never_stopped(make_trainer, tmp_path):
    assert_resumes_exactly(make_trainer, tmp_path, "frames=640")
