"""Signals: what they end, when, and what they leave alone; the state of random generators."""

import os
import signal
import threading
from types import SimpleNamespace

import pytest
import torch
from point_mass_runs import point_mass_trainer
from tensordict import TensorDict
from torchrl.checkpoint import GlobalRNGState

from safe_rl.runs.table import read_table
from safe_rl.training.state import (
    EnvSnapshot,
    Progress,
    RandomGenerators,
    catching_signals,
    staggered_steps,
)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_the_run_after_the_epoch_with_a_checkpoint(tmp_path, number):
    trainer = point_mass_trainer(tmp_path, "frames=100_000_000")
    trainer.callbacks = [lambda row: signal.raise_signal(number) if row["epoch"] == 3 else None]
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


def test_a_terminal_that_is_ignored_or_closed_stops_no_run(monkeypatch):
    def fail(*arguments):
        raise OSError

    monkeypatch.setattr(os, "write", fail)
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with catching_signals() as received:
            signal.raise_signal(signal.SIGHUP)
            assert not received
            signal.raise_signal(signal.SIGTERM)
    finally:
        signal.signal(signal.SIGHUP, before)
    assert received == [signal.SIGTERM]


def test_signals_are_left_alone_outside_the_main_thread():
    def request():
        with catching_signals():
            handlers.append(signal.getsignal(signal.SIGINT))

    handlers = [signal.getsignal(signal.SIGINT)]
    thread = threading.Thread(target=request)
    thread.start()
    thread.join()
    assert handlers[1] == handlers[0]


def test_counters_of_a_run_that_has_just_begun_are_restored():
    progress = Progress(3, 40, 5.0)
    progress.load_state_dict(Progress().state_dict())
    assert progress == Progress()


def test_as_many_generators_are_restored_as_there_are_accelerators(monkeypatch):
    for kind, count in {"cuda": 1, "xpu": 0, "mps": 1}.items():
        monkeypatch.setattr(getattr(torch, kind), "device_count", lambda count=count: count)
    restored = {}
    monkeypatch.setattr(GlobalRNGState, "load_state_dict", lambda _, s: restored.update(s))
    state = {"torch_cpu": "a", "torch_cuda": ["b", "c"], "torch_xpu": ["d"], "torch_mps": "ef"}
    RandomGenerators().load_state_dict(state)
    assert restored == {"torch_cpu": "a", "torch_cuda": ["b"], "torch_mps": "ef"}
    assert len(state) == 4


@pytest.mark.parametrize(
    ("state", "expected"),
    [({"step_count": 0}, [0, 4, 8, 16]), ({"other": 0}, None), (None, None)],
)
def test_rows_start_at_decisions_spread_over_the_longest_episode(state, expected):
    # of 22 steps: 0, 5, 11, 16 rounded down
    world = {"batch_size": torch.Size([4]), "max_episode_steps": 22, "steps_per_decision": 4}
    steps = staggered_steps(SimpleNamespace(get_state=lambda: state, **world))
    assert (steps if steps is None else steps.tolist()) == expected


def test_a_state_from_a_file_goes_to_the_devices_of_the_environment():
    present = TensorDict({"a": torch.ones(2), "t": {"x": torch.ones(2)}}, [2]).to("meta")
    met = []
    env = SimpleNamespace(get_state=lambda: present, set_state=met.append, batch_size=[2])
    snapshot = EnvSnapshot(env, SimpleNamespace(_carrier=SimpleNamespace(update=lambda _: None)))
    # an entry that the present state lacks stays where it is
    snapshot.load_state_dict({"a": torch.ones(2), "t": {"x": torch.ones(2)}, "b": torch.ones(2)})
    assert met[0].pop("b").device.type == "cpu"
    assert {value.device.type for value in met[0].values(True, True)} == {"meta"}
