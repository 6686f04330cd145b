"""Signals: what they end, when, and what they leave alone; the state of random generators."""

import signal
import threading
from types import SimpleNamespace

import pytest
import torch
from point_mass_runs import point_mass_trainer
from tensordict import TensorDict

from safe_rl.runs.table import read_table
from safe_rl.training.state import EnvSnapshot, RandomGenerators, catching_signals


def signal_in(trainer, epoch, number):
    """Let a signal come while an epoch is recorded."""
    record = trainer.writer.add

    def record_and_signal(row):
        record(row)
        if row["epoch"] == epoch:
            signal.raise_signal(number)

    trainer.writer.add = record_and_signal


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_the_run_after_the_epoch_with_a_checkpoint(tmp_path, number):
    trainer = point_mass_trainer(tmp_path, "frames=100_000_000")
    signal_in(trainer, 3, number)
    before = signal.signal(number, signal.SIG_DFL)  # nohup ignores SIGHUP
    trainer.run()
    assert signal.signal(number, before) is signal.SIG_DFL
    assert read_table(tmp_path / "progress.csv")["epoch"] == [1, 2, 3]
    assert [path.name for path in (tmp_path / "checkpoints" / "last").iterdir()] == [
        "checkpoint-000000000480.torchrl"
    ]


def test_a_signal_before_the_first_epoch_lets_it_end(tmp_path):
    trainer = point_mass_trainer(tmp_path, "frames=100_000_000")
    begin = trainer._checkpoints.begin
    trainer._checkpoints.begin = lambda: signal.raise_signal(signal.SIGTERM) or begin()
    trainer.run()
    assert trainer.stopped_by is signal.SIGTERM
    assert read_table(tmp_path / "progress.csv")["epoch"] == [1]


@pytest.fixture
def interrupts_are_not_ignored():
    """What a shell runs in the background ignores them."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("interrupts_are_not_ignored")
def test_a_second_interrupt_acts_at_once():
    with catching_signals() as received:
        signal.raise_signal(signal.SIGINT)
        assert received == [signal.SIGINT]
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)


def test_signals_are_left_alone_outside_the_main_thread():
    def request():
        with catching_signals():
            handlers.append(signal.getsignal(signal.SIGINT))

    handlers = [signal.getsignal(signal.SIGINT)]
    thread = threading.Thread(target=request)
    thread.start()
    thread.join()
    assert handlers[1] == handlers[0]


def test_a_machine_without_accelerators_restores_the_generator_of_its_cpu(monkeypatch):
    for kind in (torch.cuda, torch.xpu, torch.mps):
        monkeypatch.setattr(kind, "device_count", lambda: 0)
    state = RandomGenerators().state_dict()
    drawn = torch.rand(3)
    other = state["torch_cpu"]
    RandomGenerators().load_state_dict({**state, "torch_cuda": [other] * 2, "torch_mps": other})
    assert torch.equal(torch.rand(3), drawn)


def test_a_state_from_a_file_goes_to_the_devices_of_the_environment():
    present = TensorDict({"a": torch.ones(2), "t": {"x": torch.ones(2)}}, [2]).to("meta")
    met = []
    env = SimpleNamespace(get_state=lambda: present, set_state=met.append, batch_size=[2])
    snapshot = EnvSnapshot(env, SimpleNamespace(_carrier=SimpleNamespace(update=lambda _: None)))
    snapshot.load_state_dict({"a": torch.ones(2), "t": {"x": torch.ones(2)}})
    assert {value.device.type for value in met[0].values(True, True)} == {"meta"}
