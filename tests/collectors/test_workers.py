"""Collection by several processes: rows, weights, noise, and workers that die."""

import os
import signal
import subprocess
import time
from functools import partial
from multiprocessing import active_children, parent_process
from threading import Thread

import point_mass
import pytest
import torch
from commands import in_a_process
from point_mass import Forgetful, PointMass

from safe_rl.collectors import WorkerCollector, make_process_collector, make_ray_collector
from safe_rl.collectors.workers import split_rows
from safe_rl.envs import SafetyGymEnv, make_env
from safe_rl.envs.transforms import transform_env
from safe_rl.models import BehaviourPolicy, make_actor

pytestmark = pytest.mark.long

CONFIG = {"robot_base": "point", "task": "goal", "num_steps": 30, "observe_goal_lidar": True}
MAKE = partial(SafetyGymEnv, CONFIG, seed=3, num_threads=1)
NOISE = {"_target_": "safe_rl.envs.transforms.SensorNoise", "std": 0.5}


@pytest.mark.parametrize("transforms", [{}, {"noise": NOISE}])
def test_workers_step_the_rows_that_one_process_would(transforms):
    """With the noise that those would have, and with first episodes at different steps."""
    make = partial(make_env, CONFIG, seed=3, num_threads=1, transforms=transforms)
    whole = make(num_envs=6)
    first_steps = torch.arange(6) * 5
    shares = [make() for make in split_rows(whole, make, 3, first_steps)]
    expected = whole.reset()["observation"]
    rows = torch.cat([share.reset()["observation"] for share in shares])
    assert torch.equal(rows, expected)
    counts = [torch.cat([one.get_state()["step_count"] for one in shares])]
    _ = [one.reset() for one in shares]
    counts.append(torch.cat([one.get_state()["step_count"] for one in shares]))
    assert [count.tolist() for count in counts] == [first_steps.tolist(), [0] * 6]
    assert len({tuple(row.tolist()) for row in rows}) == 6


def test_workers_have_seeds_and_a_schedule_also_where_worlds_cannot_be_stored():
    simmer = {
        "_target_": "safe_rl.envs.transforms.Simmer", "budgets": {"cost": 2.0}, "first": 0.25,
        "steps": 16, "discount": 1.0, "unsafe_reward": -1.0, "rescale_budgets": False,
    }  # fmt: skip

    def make(num_envs):
        return transform_env(Forgetful(num_envs), {"simmer": simmer}, evaluating=False)

    whole = make(num_envs=4)
    whole.continue_from(8)
    starts = [make().reset()["observation"] for make in split_rows(whole, make, num_collectors=2)]
    assert not torch.isclose(*(start[:, :2] for start in starts)).all(-1).any()
    for start in starts:
        assert start[:, -1].tolist() == pytest.approx([0.625] * 2)


class Seeding(PointMass):
    def _set_seed(self, seed):
        super()._set_seed(seed)
        torch.manual_seed(seed)  # as TorchRL's tutorials have it


def test_workers_have_noise_of_their_own_whatever_seeding_does():
    shares = split_rows(Seeding(4), Seeding, num_collectors=2)
    drawn = [(make(), torch.rand(3).tolist())[1] for make in shares]
    assert drawn[0] != drawn[1]


@pytest.mark.parametrize(
    ("num_collectors", "frames", "why"),
    [
        (4, 60, "num_envs must be a multiple"),
        (2, 63, "63 cannot be shared equally among 6"),
        (0, 60, "num_collectors=0"),
    ],
)
def test_numbers_that_cannot_be_shared(num_collectors, frames, why):
    with pytest.raises(ValueError, match=why):
        make_process_collector(
            MAKE(num_envs=6), MAKE, None,
            frames_per_batch=frames, num_collectors=num_collectors, device="cpu",
        )  # fmt: skip


def collect(make_env=MAKE, make_collector=make_process_collector, num_collectors=2, **options):
    """A collector of batches [4, 20], and the actor that it runs."""
    env = make_env(num_envs=4)
    size = env.observation_spec["observation"].shape[-1]
    actor = make_actor(size, 2, hidden_sizes=[8], initial_log_std=-0.5)
    numbers = {"frames_per_batch": 80, "num_collectors": num_collectors, "device": "cpu"}
    return make_collector(env, make_env, BehaviourPolicy(actor), **numbers, **options), actor


def next_of(batches, actor):
    """A batch that the actor's present weights have made; then they change."""
    batch = next(batches)
    assert batch.shape == (4, 20)
    assert torch.allclose(batch["loc"], actor.get_dist(batch).base_dist.loc, atol=1e-6)
    noise = (batch["action"] - batch["loc"])[:, 0, 0]
    assert len(set(noise.tolist())) == 4
    with torch.no_grad():
        for parameter in actor.parameters():
            parameter.add_(0.1)
    return batch


def test_batches_follow_the_weights_until_a_worker_dies():
    collector, actor = collect()
    batches = iter(collector)
    first, second, _ = (next_of(batches, actor).clone() for _ in range(3))
    # rows continue where they were, unless their episode of 30 steps has ended
    kept = ~first["next", "done"][:, -1, 0]
    assert torch.equal(second["observation"][kept, 0], first["next", "observation"][kept, -1])
    os.kill(collector._processes[1].pid, signal.SIGKILL)
    start = time.monotonic()
    with pytest.raises(RuntimeError, match=r"died \(exit code -9, mostly for.*resume="):
        next(batches)
    assert time.monotonic() - start < 300
    collector.shutdown()


def test_workers_leave_signals_to_the_first_process_from_their_start_on():
    """Ctrl-C and what ends a cluster's job reach all; the first one ends its epoch with them."""
    collector, _ = collect(num_collectors=1)

    def send_signals():
        deadline = time.monotonic() + 300
        while not active_children() and time.monotonic() < deadline:
            time.sleep(0.01)
        for name in ("INT", "TERM"):
            subprocess.run(["kill", f"-{name}", str(active_children()[0].pid)], check=True)

    starting = Thread(target=send_signals, daemon=True)
    starting.start()
    batches = iter(collector)
    next(batches)
    starting.join(300)
    send_signals()
    for _ in range(2):
        assert next(batches).shape == (4, 20)
    (process,) = active_children()
    collector.shutdown(timeout=0.0)
    process.join(300)
    assert not process.is_alive()


def test_what_keeps_workers_from_starting_is_told():
    def start(makers):
        raise OSError("no room for another process")

    collector = WorkerCollector(start, PointMass(4, 20), PointMass, 2, "cpu")
    with pytest.raises(OSError, match="no room for another process"):
        next(iter(collector))
    collector.shutdown()


def fail():
    raise MemoryError("too many worlds")


def make_in_trouble(trouble, *, num_envs):
    """An environment, but in a worker something happens."""
    if parent_process() is not None:
        trouble()
    return MAKE(num_envs=num_envs)


def collect_in_trouble(trouble):
    """Run by a process of its own, which has to end as well."""
    next(iter(collect(partial(make_in_trouble, trouble), num_collectors=1)[0]))


SCRIPT = """
import os, sys
from functools import partial
sys.path[:0] = {path!r}
import safe_rl
import test_workers
if __name__ == "__main__":
    try:
        test_workers.collect_in_trouble(partial(os._exit, 9))
    except Exception as error:
        print(error)
    test_workers.collect_in_trouble(test_workers.fail)
"""


def test_a_worker_in_trouble_while_it_starts_ends_the_run_with_the_reason(tmp_path):
    script = tmp_path / "script.py"
    path = [os.path.dirname(file) for file in (__file__, point_mass.__file__)]
    script.write_text(SCRIPT.format(path=path))
    said = in_a_process(str(script), status=1)
    assert "A worker could not begin; what it says is above." in said
    assert "too many worlds" in said


@pytest.mark.slow
def test_actors_of_ray_follow_the_weights():
    ray = pytest.importorskip("ray")
    collector, actor = collect(
        make_collector=make_ray_collector,
        ray_init={"num_cpus": 2, "include_dashboard": False},
        resources={"num_cpus": 1, "num_gpus": 0},
    )
    try:
        batches = iter(collector)
        for _ in range(3):
            next_of(batches, actor)
    finally:
        collector.shutdown()
        ray.shutdown()
