"""Algorithms and losses of one's own: their runs are trained, resumed and evaluated as others.

The loop knows nothing of an algorithm of another kind.
"""

import pytest
import torch
from point_mass import PointMass
from point_mass_runs import point_mass_trainer
from run_configs import assert_resumes_exactly
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.objectives import A2CLoss, ClipPPOLoss, KLPENPPOLoss

from safe_rl.algorithms import Algorithm
from safe_rl.algorithms.losses import LossState
from safe_rl.checks import SettingError
from safe_rl.evaluation.episodes import collect_episodes
from safe_rl.evaluation.loading import load_policy
from safe_rl.models import make_actor
from safe_rl.objectives import PPOLagrangianLoss, TRPOLagrangianLoss
from safe_rl.runs.run import Run
from safe_rl.runs.table import read_table
from safe_rl.training.building import begin_from
from safe_rl.trust import allow

pytestmark = pytest.mark.long
allow(__name__)


def make_policy(env):
    return TensorDictModule(nn.Linear(4, env.action_spec.shape[-1]), ["observation"], ["action"])


class Drifting(Algorithm):
    """Moves its policy a little after every batch, and keeps them in a replay buffer."""

    cost_keys = ()

    def __init__(self, env):
        self.policy = make_policy(env)
        self.networks = {"explorer": self.policy}
        self._buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(2000), batch_size=64)

    @classmethod
    def from_config(cls, config, env):
        return cls(env)

    @classmethod
    def build_policy(cls, config, env, device):
        policy = make_policy(env)
        return policy, {"explorer": policy}

    def learn(self, batch, episodes):
        self._buffer.extend(batch.reshape(-1))
        with torch.no_grad():
            self.policy.module.bias += 0.01
        return {"sampled_reward": self._buffer.sample()["next", "reward"].mean().item()}

    def checkpoint_components(self):
        return {**self.networks, "buffer": self._buffer}


@pytest.fixture
def make_trainer(tmp_path):
    (tmp_path / "algo").mkdir()
    (tmp_path / "algo" / "mine.yaml").write_text(
        "# @package _global_\nalgo: {name: mine, _target_: test_own_algorithms.Drifting}\n"
        "model: {hidden_sizes: [8]}\ncritic_update: {minibatch_size: 1, num_passes: 1}\n"
    )

    own = (f"hydra.searchpath=[file://{tmp_path}]", "algo=mine", "cost_limits={}")
    return lambda name, *more: point_mass_trainer(tmp_path / name, *own, *more, minibatch_size=None)


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
    bias = trainer.algorithm.policy.module.bias
    assert torch.equal(second.algorithm.policy.module.bias, bias)
    config, env = Run(tmp_path / "run").config, PointMass(2, 20)
    checkpoint = Run(tmp_path / "run").find_checkpoint("last")
    policy = load_policy(config, env, checkpoint, torch.device("cpu"))
    assert torch.equal(policy.module.bias, bias)
    episodes = collect_episodes(env, policy, 3, env.cost_keys, deterministic=False)
    assert episodes.lengths.tolist() == [20, 20, 20]


def test_a_column_that_training_measures_is_not_replaced(make_trainer, monkeypatch):
    monkeypatch.setattr(Drifting, "learn", lambda self, *_: {"episode_cost": -7.0})
    with pytest.raises(SettingError, match="'learn' returned episode_cost, which training"):
        make_trainer("run").run()


def test_it_resumes_with_its_buffer_as_if_it_had_never_stopped(make_trainer, tmp_path):
    assert_resumes_exactly(make_trainer, tmp_path, "frames=640")


class _Remembering:
    """Counts its calls in a buffer that it replaces, and learns a number and a layer."""

    extra_out_keys = ("loss_own", "calls", "number")

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.register_buffer("calls", torch.zeros(()))
        self.number = nn.Parameter(torch.zeros(()))
        self.layer = nn.Linear(1, 1)

    def _surrogates(self, tensordict, log_weight):
        self.calls = self.calls + 1
        own = (self.number - self.layer(torch.ones(1)).sum() - 1).square()
        said = {"loss_own": own, "calls": self.calls.clone(), "number": self.number.detach()}
        return super()._surrogates(tensordict, log_weight) | said


class RememberingPPO(_Remembering, PPOLagrangianLoss):
    extra_out_keys = ("clip_fraction", *_Remembering.extra_out_keys)


class RememberingTRPO(_Remembering, TRPOLagrangianLoss):
    pass


def _trainer(folder, algo, loss, frames, *overrides):
    return point_mass_trainer(
        folder,
        *(f"algo={algo}", f"loss._target_={__name__}.{loss}", f"frames={frames}", *overrides),
        minibatch_size=None if algo.startswith("trpo") else 40,
    )


@pytest.mark.parametrize(
    ("algo", "loss"), [("ppo_lagrangian", "RememberingPPO"), ("trpo_lagrangian", "RememberingTRPO")]
)
def test_a_resumed_run_restores_it(tmp_path, algo, loss):
    make = lambda name, *first: _trainer(tmp_path / name, algo, loss, 640, *first)  # noqa: E731
    assert_resumes_exactly(make, tmp_path, "frames=320")


def test_coefficients_are_those_of_the_resumed_run(tmp_path):
    given = ("ppo_lagrangian", "RememberingPPO")
    _trainer(tmp_path, *given, 320).run()
    resumed = _trainer(tmp_path, *given, 640, "loss.clip_epsilon=0.05", "loss.entropy_coeff=0.5")
    assert resumed.resume()
    loss = resumed.algorithm.policy_update.loss
    assert (float(loss.clip_epsilon), float(loss.entropy_coeff)) == pytest.approx((0.05, 0.5))
    assert loss.calls > 0


@pytest.mark.parametrize("kind", [A2CLoss, ClipPPOLoss, KLPENPPOLoss])
def test_losses_of_torchrl_s_keep_no_settings_of_their_value_estimators(kind):
    actor = make_actor(3, 2, hidden_sizes=[8], initial_log_std=-0.5)
    critic = TensorDictModule(nn.Linear(3, 1), ["observation"], ["state_value"])
    loss = kind(actor, critic)
    loss.make_value_estimator(gamma=0.9, lmbda=0.8)
    assert not LossState({"loss": loss}, saved_elsewhere=[actor, critic]).tensors
