"""What a memory gives back: the transitions that went in, over one step or over several."""

import re

import pytest
import torch
from commands import ROOT
from tensordict import TensorDict
from torchrl.envs import MultiStepTransform

from safe_rl.algorithms import Memory

PAGE = ROOT / "docs/coming_from/torchrl.md"
IN_KEYS = [
    *("observation", "action"),
    *(("next", key) for key in ("observation", "reward", "cost", "terminated", "done")),
]


def make_memory(**keys):
    settings = {
        "capacity": 1000, "batch_size": 64, "in_keys": IN_KEYS,
        "summed": ["reward", "cost"], "gamma": 0.5, "n_steps": 1, "keep": True,
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


def test_there_are_as_many_minibatches_as_asked_for():
    """They are drawn several at once, here 16 of 1,024 transitions."""
    memory = make_memory(batch_size=1024)
    memory.extend(make_batch(0, 5))
    for number in (1, 16, 33):
        assert [len(minibatch) for minibatch in memory.minibatches(number)] == [1024] * number


def test_the_oldest_go_first():
    memory = make_memory(capacity=6)
    for first in range(0, 10, 2):
        memory.extend(make_batch(first, 2, rows=1))
    assert sorted(all_of(memory)) == [4, 5, 6, 7, 8, 9]


def assert_sums(found, ends, length, terminates=True):
    """Those over three steps, or up to an end of an episode or of the rows."""
    for observation, step in found.items():
        time = int(observation % 1000)
        last = min([time + 2, length - 1, *(end for end in ends if end >= time)])
        assert step["steps_to_next_obs"] == last + 1 - time
        assert step["next", "observation"] == observation + last + 1 - time
        reward = sum(0.5 ** (then - time) * then for then in range(time, last + 1))
        assert step["next", "reward"].item() == pytest.approx(reward)
        cost = reward + 100 * sum(0.5**i for i in range(last + 1 - time))
        assert step["next", "cost"].item() == pytest.approx(cost)
        # what an end does to values is that of the transition's last step
        assert step["next", "done"].item() is (last in {*ends, length - 1})
        assert step["next", "terminated"].item() is (last in ends and terminates)


@pytest.mark.parametrize("terminates", [True, False])
def test_several_steps_are_summed_across_batches_and_not_across_ends(terminates):
    memory = make_memory(n_steps=3)
    for first in range(0, 12, 4):
        memory.extend(make_batch(first, 4, ends=[5], terminates=terminates))
    found = all_of(memory)
    assert sorted(found) == [row + time for row in (0, 1000) for time in range(9)]
    assert_sums(found, [5], 12, terminates)


@pytest.mark.parametrize(("length", "ends"), [(2, [1]), (8, [2, 7]), (8, [2])])
def test_rows_that_end_keep_no_step_back(length, ends):
    """The last episode of a dataset's row may be the only one that it has."""
    memory = make_memory(n_steps=3)
    memory.extend(make_batch(0, length, ends=ends))
    memory.end_rows()
    memory.extend(make_batch(50, 4))
    found = {o: step for o, step in all_of(memory).items() if o % 1000 < 50}
    assert sorted(found) == [row + time for row in (0, 1000) for time in range(length)]
    assert_sums(found, ends, length)


def test_sums_do_not_go_on_in_other_trajectories():
    memory, ended = make_memory(n_steps=3), make_memory(n_steps=3)
    # the trajectory changes within a batch, between two batches, and where no episode has ended
    for first, trajectories, is_last in (
        *((0, [1, 1, 1, 2], False), (4, [2, 3, 3, 3], True), (50, [4, 4, 4, 4], True)),
    ):
        batch = make_batch(first, 4, ends=[2, 4])
        ended.extend(batch)
        if is_last:
            ended.end_rows()
        batch["collector", "traj_ids"] = torch.tensor(trajectories).expand(2, -1)
        memory.extend(batch)
    memory.end_rows()
    assert torch.equal(*(m.state_dict()["steps"]["steps_to_next_obs"] for m in (memory, ended)))


def test_the_page_on_torchrl_names_the_settings_of_its_transform():
    (named,) = re.findall(r"`MultiStepTransform` \| the same, with `(.*?)`", PAGE.read_text())
    transform, memory = MultiStepTransform(3, 0.5, **eval(f"dict({named})")), make_memory(n_steps=3)
    memory.extend(batch := make_batch(0, 9, rows=1, ends=[5]))
    expected, found = memory.state_dict()["steps"], transform.inv(batch)["next"].flatten_keys("/")
    for key in ("observation", "reward", "cost", "terminated"):
        assert torch.equal(found[key][0], expected[f"next/{key}"])


def test_a_copy_on_another_device_goes_on_there():
    memory, copy = (make_memory(n_steps=3, device=device) for device in ("cpu", "meta"))
    memory.extend(make_batch(0, 2))
    copy.load_state_dict(memory.state_dict())
    copy.extend(make_batch(2, 1).to("meta"))
    assert copy.state_dict()["tail"]["observation"].is_meta


def test_sums_over_long_rows_are_those_of_all_their_episodes():
    """A row of a dataset has all of its episodes; it is summed piece by piece."""
    memory, length = make_memory(n_steps=3, capacity=20_000), 6_000
    batch = make_batch(0, length, ends=range(9, length, 10))
    memory.extend(batch)
    # one after the other, as rows of batches that are shorter come
    steps = memory.state_dict()["steps"]
    observations = torch.stack([torch.arange(length - 3) + 1000.0 * row for row in range(2)])
    assert torch.equal(steps["observation"].reshape(2, -1), observations)
    spanned = (10 - torch.arange(length - 3) % 10).clamp(max=3)
    assert torch.equal(steps["steps_to_next_obs"].reshape(2, -1), spanned.expand(2, -1))
    following = steps["next/observation"].reshape(2, -1)
    assert torch.equal(following, observations + spanned)
