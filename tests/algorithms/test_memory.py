"""What a memory gives back: the transitions that went in, over one step or over several."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.data.replay_buffers.samplers.prioritized import SumSegmentTreeFp32

from safe_rl.algorithms import Memory

IN_KEYS = [
    *("observation", "action"),
    *(("next", key) for key in ("observation", "reward", "cost", "terminated", "done")),
]


def make_memory(**keys):
    settings = {
        "capacity": 1000, "batch_size": 64, "in_keys": IN_KEYS, "reward_keys": ["reward", "cost"],
        "reward_gamma": 0.5, "n_steps": 1, "storage": "tensor", "keep": True,
    }  # fmt: skip
    return Memory(**{**settings, **keys})


def make_batch(first, length, rows=2, ends=(), terminates=True):
    """Steps whose observations count 0, 1, 2, … in every row, ending after those in ``ends``."""
    times = torch.arange(first, first + length).expand(rows, -1).unsqueeze(-1)
    observations = times + 1000 * torch.arange(rows).reshape(-1, 1, 1)
    done = torch.isin(times, torch.tensor(ends))
    following = {
        "observation": observations + 1.0, "reward": times + 0.0, "cost": times + 100.0,
        "done": done, "terminated": done & terminates, "truncated": done & (not terminates),
        "goal_met": done,
    }  # fmt: skip
    return TensorDict(
        observation=observations + 0.0, action=-times + 0.0, next=following,
        batch_size=[rows, length],
    )  # fmt: skip


def all_of(memory):
    """Transitions by observation."""
    drawn = torch.cat(list(memory.minibatches(40)))
    return {o: drawn[i] for i, o in enumerate(drawn["observation"].flatten().tolist())}


def test_transitions_come_back_as_they_went_in():
    memory = make_memory()
    memory.extend(make_batch(0, 5))
    memory.extend(make_batch(5, 3, ends=[6]))
    found = all_of(memory)
    assert len(memory) == len(found) == 16
    for observation, step in found.items():
        time = observation % 1000
        assert step["next", "observation"] == observation + 1
        assert (step["action"], step["next", "reward"]) == (-time, time)
        assert step["next", "cost"] == time + 100
        assert step["next", "done"] == (time == 6)
        assert "goal_met" not in step["next"].keys()  # noqa: SIM118


def test_the_oldest_go_first():
    memory = make_memory(capacity=6)
    for first in range(0, 10, 2):
        memory.extend(make_batch(first, 2, rows=1))
    assert sorted(all_of(memory)) == [4, 5, 6, 7, 8, 9]


@pytest.mark.parametrize("terminates", [True, False])
def test_several_steps_are_summed_across_batches_and_not_across_ends(terminates):
    memory = make_memory(n_steps=3)
    for first in range(0, 12, 4):
        memory.extend(make_batch(first, 4, ends=[5], terminates=terminates))
    found = all_of(memory)
    assert sorted(found) == [row + time for row in (0, 1000) for time in range(9)]
    for observation, step in found.items():
        time = int(observation % 1000)
        length = min(3, 6 - time) if time <= 5 else 3
        assert step["steps_to_next_obs"] == length
        assert step["next", "observation"] == observation + length
        reward = sum(0.5**i * (time + i) for i in range(length))
        assert step["next", "reward"].item() == pytest.approx(reward)
        cost = reward + 100 * sum(0.5**i for i in range(length))
        assert step["next", "cost"].item() == pytest.approx(cost)
        # what an end does to values is that of the transition's last step
        reaches_the_end = time <= 5 <= time + length - 1
        assert step["next", "done"].item() is reaches_the_end
        assert step["next", "terminated"].item() is (reaches_the_end and terminates)


@pytest.mark.parametrize("storage", ["tensor", "memmap"])
@pytest.mark.parametrize("n_steps", [1, 3])
@pytest.mark.parametrize("batches", [0, 1, 4])
def test_a_copy_goes_on_in_the_same_way(storage, n_steps, batches, tmp_path):
    keys = {"storage": storage, "n_steps": n_steps, "capacity": 20}
    memory, copy = make_memory(**keys), make_memory(**keys)
    copy.extend(make_batch(50, 4))  # which loading forgets
    for number in range(batches):
        memory.extend(make_batch(5 * number, 5))
    torch.save(memory.state_dict(), tmp_path / "state")
    copy.load_state_dict(torch.load(tmp_path / "state", weights_only=True))
    assert len(memory) == len(copy)
    drawn = []
    for each in (memory, copy):
        torch.manual_seed(3)
        each.extend(make_batch(5 * batches, 5))
        drawn.append(torch.cat([m["observation"] for m in each.minibatches(3)]))
    assert len(memory) == len(copy)
    assert torch.equal(*drawn)


def make_prioritised(**keys):
    keys |= {"keep": False, "prioritised": {"alpha": 1.0, "beta": 1.0}}
    if SumSegmentTreeFp32 is None:
        with pytest.raises(ValueError, match="prioritised=null"):
            make_memory(**keys)
        pytest.skip("torchrl is installed without its compiled extension")
    return make_memory(**keys)


def test_large_errors_are_drawn_more_often():
    memory = make_prioritised()
    memory.extend(make_batch(0, 10, rows=1))
    for minibatch in memory.minibatches(5):
        minibatch["td_error"] = torch.where(minibatch["observation"].squeeze(-1) == 3, 9.0, 1.0)
        memory.learned(minibatch)
    drawn = torch.cat([m["observation"] for m in memory.minibatches(100)])
    assert (drawn == 3).float().mean().item() == pytest.approx(0.5, abs=0.03)


def test_only_a_memory_that_is_kept_is_part_of_checkpoints():
    assert set(make_memory().components()) == {"memory"}
    assert not make_memory(keep=False).components()
    with pytest.raises(ValueError, match="Priorities cannot be kept"):
        make_memory(prioritised={"alpha": 1.0, "beta": 1.0})


def test_a_storage_that_does_not_exist_is_named():
    with pytest.raises(ValueError, match="storage=disk: it must be one of tensor, memmap"):
        make_memory(storage="disk")
