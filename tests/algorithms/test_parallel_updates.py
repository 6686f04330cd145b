"""Policy and critics learn at the same time what they learn one after the other."""

import threading

import pytest
import torch
from point_mass_runs import point_mass_trainer
from torchrl.envs.utils import ExplorationType, exploration_type, set_exploration_type

from safe_rl.algorithms import on_policy
from safe_rl.algorithms.processor_use import in_parallel, torch_threads
from safe_rl.objectives import PPOLoss
from safe_rl.trust import allow

allow(__name__)


class WithCritic(PPOLoss):
    """A loss of one's own that has the critic among its parameters."""

    def __init__(self, actor_network, critic_network, **settings):
        super().__init__(actor_network, **settings)
        self.critic = critic_network


@pytest.fixture
def two_threads():
    with torch_threads(2):
        yield


@pytest.fixture
def calls(monkeypatch):
    """What would be done at the same time, done one after the other."""
    noted = []
    monkeypatch.setattr(
        on_policy, "in_parallel", lambda *both: noted.append(both) or [call() for call in both]
    )
    return noted


def test_both_are_under_way_at_once(two_threads):
    meeting = threading.Barrier(2, timeout=10)  # breaks unless both come
    assert in_parallel(meeting.wait, meeting.wait) in {(0, 1), (1, 0)}


def test_the_exploration_type_is_afterwards_what_it_was(two_threads):
    """Every loss sets that of the process and puts it back: A in, B in, A out, B out."""
    steps = [threading.Event() for _ in range(3)]

    def first():
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            steps[0].set()
            steps[1].wait(10)
        steps[2].set()

    def second():
        steps[0].wait(10)
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            steps[1].set()
            steps[2].wait(10)

    before = exploration_type()
    in_parallel(first, second)
    assert exploration_type() == before


@pytest.mark.parametrize("number", [1, 2])
def test_both_are_called_with_the_exploration_type_of_losses(number):
    with torch_threads(number), set_exploration_type(ExplorationType.RANDOM):
        found = in_parallel(exploration_type, exploration_type)
    assert found == (ExplorationType.DETERMINISTIC, ExplorationType.DETERMINISTIC)


def test_with_one_thread_one_is_called_after_the_other():
    calls = []
    with torch_threads(1):
        in_parallel(*(lambda n=n: calls.append((n, threading.get_ident())) for n in (1, 2)))
    assert calls == [(n, threading.get_ident()) for n in (1, 2)]


def test_threads_are_shared_and_given_back(two_threads):
    assert in_parallel(torch.get_num_threads, torch.get_num_threads) == (1, 1)
    assert torch.get_num_threads() == 2


@pytest.mark.parametrize("fails", [0, 1])
def test_the_other_ends_before_an_error_is_raised(two_threads, fails):
    ended = threading.Event()
    failed = threading.Event()

    def fail():
        failed.set()
        raise FloatingPointError("diverged")

    def end():
        failed.wait(10)
        ended.set()

    calls = [end, end]
    calls[fails] = fail
    with pytest.raises(FloatingPointError, match="diverged"):
        in_parallel(*calls)
    assert ended.is_set()
    assert torch.get_num_threads() == 2


@pytest.mark.parametrize(
    ("loss", "number"), [("safe_rl.objectives.PPOLoss", 1), (f"{__name__}.WithCritic", 0)]
)
def test_a_loss_that_moves_the_critic_comes_before_its_fit(loss, number, tmp_path, calls):
    trainer = point_mass_trainer(tmp_path, "algo=ppo", f"loss._target_={loss}")
    row = trainer.epoch(iter(trainer.collector))
    assert len(calls) == number
    assert row["policy_num_steps"] > 0
    assert row["critic_num_steps"] == 4


def test_an_actor_that_shares_layers_with_the_critic_is_moved_before_its_fit(tmp_path, calls):
    """Also by a step on a plain function, which has no parameters of its own."""
    trainer = point_mass_trainer(tmp_path, "algo=trpo", minibatch_size=None)
    algorithm = trainer.algorithm
    loss = algorithm.policy_update.loss
    algorithm.policy_update.loss = lambda batch: loss(batch)
    batches = iter(trainer.collector)
    trainer.epoch(batches)
    assert len(calls) == 1
    algorithm.actor.add_module("trunk", algorithm.critic.module)
    trainer.epoch(batches)
    assert len(calls) == 1
