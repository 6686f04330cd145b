"""What a loss of one's own keeps from batch to batch is part of a checkpoint."""

import pytest
import torch
from point_mass_runs import point_mass_trainer
from run_configs import assert_resumes_exactly
from tensordict.nn import TensorDictModule
from torchrl.objectives import A2CLoss, ClipPPOLoss, KLPENPPOLoss

from safe_rl import trust
from safe_rl.algorithms.losses import LossState
from safe_rl.models import make_actor
from safe_rl.objectives import PPOLagrangianLoss, TRPOLagrangianLoss

pytestmark = pytest.mark.long


class _Remembering:
    """Counts its calls in a buffer that it replaces, and learns a number and a layer."""

    extra_out_keys = ("loss_own", "calls", "number")

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.register_buffer("calls", torch.zeros(()))
        self.number = torch.nn.Parameter(torch.zeros(()))
        self.layer = torch.nn.Linear(1, 1)

    def _surrogates(self, tensordict, log_weight):
        self.calls = self.calls + 1
        own = (self.number - self.layer(torch.ones(1)).sum() - 1).square()
        said = {"loss_own": own, "calls": self.calls.clone(), "number": self.number.detach()}
        return super()._surrogates(tensordict, log_weight) | said


class RememberingPPO(_Remembering, PPOLagrangianLoss):
    extra_out_keys = ("clip_fraction", *_Remembering.extra_out_keys)


class RememberingTRPO(_Remembering, TRPOLagrangianLoss):
    pass


@pytest.fixture(autouse=True)
def _allowed(monkeypatch):
    monkeypatch.setitem(trust._ROOMS, __name__, None)


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
    critic = TensorDictModule(torch.nn.Linear(3, 1), ["observation"], ["state_value"])
    loss = kind(actor, critic)
    loss.make_value_estimator(gamma=0.9, lmbda=0.8)
    assert not LossState({"loss": loss}, saved_elsewhere=[actor, critic]).tensors
