"""What updates ask of the processor: kernels that suit it, and two updates at the same time."""

import threading

import pytest
import torch
from point_mass_runs import point_mass_trainer
from torchrl.envs.utils import ExplorationType, exploration_type, set_exploration_type

from safe_rl.algorithms import on_policy, processor_use
from safe_rl.algorithms.processor_use import (
    fast_products,
    in_parallel,
    prefers_onednn,
    torch_threads,
)
from safe_rl.models.networks import cpuinfo
from safe_rl.objectives import PPOLoss
from safe_rl.trust import allow

allow(__name__)
ZEN = "vendor_id : AuthenticAMD\nmodel name : AMD EPYC\nflags : fpu avx2 avx512f avx512_bf16\n"


@pytest.fixture
def of_use(monkeypatch):
    monkeypatch.setattr(processor_use, "prefers_onednn", lambda cpuinfo: True)
    products = torch.backends.mkldnn.matmul
    before = products.fp32_precision
    yield products
    products.fp32_precision = before


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (ZEN, True),
        (ZEN.replace("AuthenticAMD", "GenuineIntel"), False),
        (ZEN.replace(" avx512f", ""), False),
        (ZEN.replace("avx512_bf16", "amx_tile"), False),
        ("CPU implementer : 0x41\nFeatures : fp asimd bf16", False),
        ("", False),
    ],
)
def test_only_where_it_is_faster_and_rounds_nothing(text, expected):
    assert prefers_onednn(text) is expected


@pytest.mark.skipif(not prefers_onednn(cpuinfo()), reason="a processor that MKL serves well")
def test_products_are_those_of_single_precision():
    rows, inner, columns = 4000, 60, 64
    generator = torch.Generator().manual_seed(0)
    left = torch.randn(rows, inner, generator=generator)
    right = torch.randn(inner, columns, generator=generator)
    exact = left.double() @ right.double()
    with fast_products():
        product = left @ right
    rounded = left.bfloat16().double() @ right.bfloat16().double()
    error = (product - exact).abs().mean()
    assert error < 1e-5
    assert (rounded - exact).abs().mean() > 1000 * error  # what would be lost by bfloat16


def test_it_is_for_the_block_alone_also_if_that_fails(of_use):
    before, seen = of_use.fp32_precision, []

    def diverge():
        with fast_products():
            seen.append(of_use.fp32_precision)
            raise FloatingPointError

    with pytest.raises(FloatingPointError):
        diverge()
    assert (seen, of_use.fp32_precision) == (["bf16"], before)


@pytest.mark.parametrize(("given", "is_available"), [("ieee", True), ("none", False)])
def test_a_precision_of_the_users_is_kept_and_that_of_a_torch_without_it(
    given, is_available, of_use, monkeypatch
):
    monkeypatch.setattr(torch.backends.mkldnn, "is_available", lambda: is_available)
    of_use.fp32_precision = given
    with fast_products():
        assert of_use.fp32_precision == given


def test_training_has_it_for_updates_alone(of_use, tmp_path, monkeypatch):
    trainer, seen = point_mass_trainer(tmp_path, "algo=ppo", "frames=160"), []
    learn = trainer.algorithm.learn
    watched = lambda *given: seen.append(of_use.fp32_precision) or learn(*given)  # noqa: E731
    monkeypatch.setattr(trainer.algorithm, "learn", watched)
    trainer.run()
    assert seen == ["bf16"]
    assert of_use.fp32_precision == "none"


class WithCritic(PPOLoss):
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
    failed, ended = threading.Event(), threading.Event()

    def fail():
        failed.set()
        raise FloatingPointError("diverged")

    def end():
        failed.wait(10)
        ended.set()

    with pytest.raises(FloatingPointError, match="diverged"):
        in_parallel(*((end, fail) if fails else (fail, end)))
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
