"""Transitions come back from disk as they were collected, and safe episodes are whole ones."""

import numpy as np
import pytest
import torch
from point_mass import PointMass
from tensordict import TensorDict
from torchrl.modules import RandomPolicy

from safe_rl.collectors import (
    EpisodeAccounting,
    Recording,
    make_collector,
    read_dataset,
    read_hdf5,
    read_recording,
    safe_episodes,
)


@pytest.fixture
def h5py():
    return pytest.importorskip("h5py", reason="comes with the extra hdf5")


def collected(batches=3):
    torch.manual_seed(0)
    env = PointMass(4, 20)
    collector = make_collector(env, RandomPolicy(env.action_spec), frames_per_batch=4 * 25)
    return [batch.clone() for batch, _ in zip(collector, range(batches), strict=False)]


def test_a_recording_is_what_was_collected(tmp_path):
    batches = collected()
    recording = Recording(tmp_path, PointMass.cost_keys)
    for number, batch in enumerate(batches):
        recording.write(number, batch)
    recording.write(1, batches[1])  # by a run that was interrupted and resumed
    found, expected = read_recording(tmp_path), torch.cat(batches, -1)
    assert found.shape == (4, 75)
    for key in ("observation", "action", ("next", "observation"), ("next", "cost_north")):
        assert torch.equal(found[key], expected[key])
    assert torch.equal(found["next", "truncated"], expected["next", "done"])
    (tmp_path / "00000002.pt").rename(tmp_path / ".00000002.0a.pt")  # as of a run killed there
    recording.begin(2)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["00000000.pt", "00000001.pt"]
    with pytest.raises(FileNotFoundError, match=r"holds no transitions: is it the folder of a rec"):
        read_recording(tmp_path / "elsewhere")
    Recording(tmp_path / "run" / "transitions", PointMass.cost_keys).write(0, batches[0])
    Recording(tmp_path / "run" / "evaluation.transitions", ["cost"]).write(0, batches[0])
    both = r"give .*/run/evaluation\.transitions or .*/run/transitions\.$"
    with pytest.raises(FileNotFoundError, match=both):
        read_recording(tmp_path / "run")


@pytest.mark.parametrize("damage", ["cut", "flipped", "no action", "another shape"])
def test_a_damaged_batch_is_refused(damage, tmp_path):
    Recording(tmp_path, ["cost"]).write(0, collected(1)[0])
    path = tmp_path / "00000000.pt"
    content, entries = bytearray(path.read_bytes()), torch.load(path)
    content[len(content) // 2] ^= 1
    if damage == "no action":
        del entries["action"]
    else:
        entries["observation"] = entries["observation"][1:]
    torch.save(entries, path)
    if damage in ("cut", "flipped"):
        path.write_bytes(content[:800] if damage == "cut" else content)
    with pytest.raises(ValueError, match=r"00000000\.pt cannot be read as steps of a run"):
        read_recording(tmp_path)


def test_episodes_end_where_batches_are_missing(tmp_path):
    """A run that was recorded, then not, and is again: what is on disk has a gap."""
    batches = collected(4)  # of 25 steps, with episodes of 20: five are open after the first
    recording = Recording(tmp_path, PointMass.cost_keys)
    for number in (0, 3):
        recording.write(number, batches[number], begun=torch.tensor([number > 0] * 4))
    steps = read_recording(tmp_path)
    assert steps["next", "done"][0].flatten().nonzero().flatten().tolist() == [19, 24, 29, 49]
    assert not steps["next", "terminated"].any()
    whole = safe_episodes(steps, {})
    # the first twenty steps and the last twenty
    assert torch.equal(
        whole["observation"].reshape(4, 40, 4),
        steps["observation"][:, [*range(20), *range(30, 50)]],
    )
    recording.cut_after(3)  # by a resumed run, of which two rows begin within an episode
    recording.write(4, batches[0], begun=torch.tensor([True, True, False, False]))
    assert read_recording(tmp_path)["partial"][:, 50, 0].tolist() == [True, True, False, False]
    (tmp_path / "00000000.pt").rename(tmp_path / "00000002.pt")
    (tmp_path / "00000003.pt").unlink()
    recording.write(2, batches[2])
    with pytest.raises(ValueError, match=r"between 00000002.pt and 00000004.pt are missing"):
        read_recording(tmp_path)


@pytest.mark.parametrize("limits", [{"cost": 2.0}, {"cost_hazards": 1.0, "cost_north": 0.0}, {}])
def test_safe_episodes_are_those_that_the_accounting_finds(limits):
    steps = torch.cat(collected(), -1)
    episodes = EpisodeAccounting(4, PointMass.cost_keys).update(steps)
    within = [episodes.costs[key] <= limit for key, limit in limits.items()]
    expected = torch.stack(within).all(0) if within else torch.ones(episodes.num_episodes) > 0
    found = safe_episodes(steps, limits)
    assert 0 < expected.sum() <= 12
    assert found.shape == (1, 20 * expected.sum())
    # whole episodes, in order: each ends once, at its last step
    ends = found["next", "done"].reshape(-1, 20)
    assert ends.nonzero()[:, 1].tolist() == [19] * len(ends)
    returns = found["next", "reward"].reshape(-1, 20).double().sum(-1)
    torch.testing.assert_close(returns, episodes.returns[expected])


def test_an_episode_at_exactly_the_limit_is_safe():
    """Also with costs of 0.1, which single precision rounds up; 1.1 is above the limit."""
    done = torch.zeros(2, 11, 1, dtype=torch.bool)
    done[0, 9] = done[1, 10] = True
    following = {"cost": torch.full((2, 11, 1), 0.1), "done": done}
    found = safe_episodes(TensorDict(next=following, batch_size=[2, 11]), {"cost": 1.0})
    assert found.shape == (1, 10)


def write_hdf5(h5py, path):
    rng = np.random.default_rng(0)
    seen = rng.normal(size=(7, 3))
    arrays = {
        "observations": seen[:-1], "next_observations": seen[1:],
        "actions": rng.normal(size=(6, 2)), "rewards": rng.normal(size=6),
        "costs": rng.integers(0, 2, 6).astype(float), "terminals": np.arange(6) == 2,
        "timeouts": np.arange(6) == 5,
    }  # fmt: skip
    with h5py.File(path, "w") as file:
        file.update(arrays)
    return arrays


def replace(h5py, path, name, value):
    """Put another value in the place of an array; {} is a group, a text says what is copied."""
    with h5py.File(path, "a") as file:
        del file[name]
        if isinstance(value, dict):
            file.create_group(name)
        elif value is not None:
            file[name] = file[value][:] if isinstance(value, str) else value


def test_files_of_offline_benchmarks_are_read(tmp_path, h5py):
    arrays = write_hdf5(h5py, tmp_path / "data.hdf5")
    steps = read_hdf5(tmp_path / "data.hdf5")
    assert steps.shape == (1, 6)
    torch.testing.assert_close(
        steps["next", "reward"], torch.tensor(arrays["rewards"]).float().reshape(1, 6, 1)
    )
    torch.testing.assert_close(steps["action"], torch.tensor(arrays["actions"]).float()[None])
    assert steps["next", "done"].flatten().tolist() == [False, False, True, False, False, True]
    assert steps["next", "terminated"].flatten().tolist().count(True) == 1


@pytest.mark.parametrize(("array", "last"), [("given", 6), ("missing", 5), ("in a circle", 5)])
def test_the_next_observation_is_never_the_next_episodes(array, last, tmp_path, h5py):
    """Also in an array that was made by a shift, whose last row is then the file's first."""
    path = tmp_path / "data.hdf5"
    arrays = write_hdf5(h5py, path)
    if array != "given":
        shifted = np.roll(arrays["observations"], -1, 0)
        replace(h5py, path, "next_observations", None if array == "missing" else shifted)
    found = read_dataset(path)["next", "observation"]
    seen = np.append(arrays["observations"], arrays["next_observations"][-1:], 0)
    rows = [1, 2, 2, 4, 5, last]  # episodes end with the third step and the sixth
    torch.testing.assert_close(found, torch.tensor(seen[rows]).float()[None])


def write_minari(h5py, path, reset_infos=True):
    """As minari/dataset/_storages/hdf5_storage.py; twelve: names in another order than numbers."""
    rng = np.random.default_rng(0)
    episodes = []
    with h5py.File(path, "w") as file:
        for number, length in enumerate((3, 12, *[1] * 10)):
            episode = {
                "observations": rng.normal(size=(length + 1, 3)),
                "actions": rng.normal(size=(length, 2)), "rewards": rng.normal(size=length),
                "terminations": np.arange(length) == (length - 1 if number == 0 else -1),
                "truncations": np.zeros(length, bool),
            }  # fmt: skip
            cost = rng.integers(0, 2, length + reset_infos).astype(float)
            cost[: int(reset_infos)] = 0
            group = file.create_group(f"episode_{number}")
            group.update(episode)
            group["infos/cost"], group["infos/cost_hazards"] = cost, 2 * cost
            group["infos/is_good"] = cost > 0
            episodes.append(episode | {"cost": cost[-length:]})
    return episodes


@pytest.mark.parametrize("reset_infos", [True, False])
def test_episodes_of_minari_are_read_in_their_order(reset_infos, tmp_path, h5py):
    episodes = write_minari(h5py, tmp_path / "main_data.hdf5", reset_infos=reset_infos)
    steps = read_dataset(tmp_path / "main_data.hdf5")
    assert steps.shape == (1, 25)
    for key, parts in {
        "observation": [e["observations"][:-1] for e in episodes],
        ("next", "observation"): [e["observations"][1:] for e in episodes],
        "action": [e["actions"] for e in episodes],
        ("next", "reward"): [e["rewards"][:, None] for e in episodes],
        ("next", "cost"): [e["cost"][:, None] for e in episodes],
        ("next", "cost_hazards"): [2 * e["cost"][:, None] for e in episodes],
    }.items():
        torch.testing.assert_close(steps[key], torch.tensor(np.concatenate(parts)).float()[None])
    ends = np.cumsum([len(e["actions"]) for e in episodes]) - 1
    assert steps["next", "done"].flatten().nonzero().flatten().tolist() == ends.tolist()
    # the first one terminates, the others were cut off
    assert steps["next", "terminated"].flatten().nonzero().flatten().tolist() == [2]
    assert "is_good" not in steps["next"].keys()  # noqa: SIM118


def test_what_is_no_dataset_is_refused(tmp_path, h5py):
    (tmp_path / "notes.txt").write_text("words")
    with pytest.raises(ValueError, match="neither the folder of a recording nor an HDF5 file"):
        read_dataset(tmp_path / "notes.txt")
    with pytest.raises(FileNotFoundError, match="no such recording"):
        read_dataset(tmp_path / "nothing")


def test_a_file_with_arrays_per_episode_is_refused_in_a_short_line(tmp_path, h5py):
    """d3rlpy 2 writes `observations_0`, `actions_0`, …, thousands of names."""
    with h5py.File(tmp_path / "d3rlpy.h5", "w") as file:
        for i in range(1000):
            file[f"actions_{i}"] = np.zeros((3, 2))
    with pytest.raises(ValueError, match=r"has no actions.*actions_0,.* and 990 more\.$") as caught:
        read_hdf5(tmp_path / "d3rlpy.h5")
    assert len(str(caught.value)) < 500


NEXT = "next_observations"
UNLIKE_OTHERS = "episode_4 has other costs than episode_0"


@pytest.mark.parametrize(
    ("name", "value", "told"),
    [
        ("actions", np.zeros((4, 2)), r"observation must be numbers of shape \(4, 3\), as there"),
        ("rewards", np.float64(1.0), "has no rewards"),
        ("rewards", None, "has no rewards.*What it has: actions"),
        ("actions", np.array([b"left"] * 6), "the action must be numbers"),
        ("costs", np.zeros((6, 2)), r"the next cost must be numbers of shape \(6,\), as"),
        (NEXT, np.zeros((6, 4)), r"numbers of shape \(6, 3\),.* shape \(6, 4\)"),
        (NEXT, "observations", "next_observations are equal to its observations"),
        (NEXT, np.ones((6, 3)), "another observation follows its step 0 than"),
        (NEXT, np.dtype("f8"), "its /next_observations is no array"),
        (NEXT, {}, "its /next_observations is no array"),
        ("terminals", np.array([0, np.nan, 0, 0, 0, 0]), "its terminals must be 0 or 1"),
        ("episode_4/observations", np.zeros((1, 3)), "episode_4: the next observation must be"),
        ("episode_4/observations", np.zeros((3, 3)), "episode_4: the next observation must be"),
        ("episode_4/infos/cost", np.zeros((1, 2)), "episode_4: the next cost must be"),
        ("episode_4/infos/cost", np.zeros(3), "episode_4: the next cost must be"),
        ("episode_4/infos/cost", np.ones(2), "episode_4: the next cost must be"),
        ("episode_4/infos/cost", {}, UNLIKE_OTHERS),
        ("episode_4/infos/cost_hazards", None, UNLIKE_OTHERS),
    ],
)
def test_a_file_whose_arrays_do_not_fit_together_is_refused(name, value, told, tmp_path, h5py):
    path = tmp_path / "data.hdf5"
    (write_minari if "/" in name else write_hdf5)(h5py, path)
    replace(h5py, path, name, value)
    with pytest.raises(ValueError, match=told):
        read_hdf5(path)


def test_files_without_costs_can_be_read(tmp_path, h5py):
    """Algorithms without limits need none; others say that it has no cost."""
    write_hdf5(h5py, tmp_path / "flat.hdf5")
    replace(h5py, tmp_path / "flat.hdf5", "costs", None)
    write_minari(h5py, tmp_path / "episodes.hdf5")
    with h5py.File(tmp_path / "episodes.hdf5", "a") as file:
        for episode in file.values():
            del episode["infos"]
    for name in ("flat", "episodes"):
        found = set(read_hdf5(tmp_path / f"{name}.hdf5")["next"].keys())
        assert found == {"observation", "reward", "done", "terminated", "truncated"}


def foreign(h5py, folder, kind):
    """What a file can hold instead of an array of its own."""
    (folder / "secret").write_bytes(np.ones(6).tobytes())
    with h5py.File(folder / "other.hdf5", "w") as other:
        other["rewards"] = np.ones(6)
    with h5py.File(folder / "data.hdf5", "a") as file:
        del file["rewards"]
        if kind == "external":
            raw = [(str(folder / "secret"), 0, 48)]
            file.create_dataset("rewards", (6,), "f8", external=raw)
        elif kind == "virtual":
            layout = h5py.VirtualLayout((6,), "f8")
            layout[:] = h5py.VirtualSource(str(folder / "other.hdf5"), "rewards", (6,))
            file.create_virtual_dataset("rewards", layout)
        elif kind == "linked":
            file["rewards"] = h5py.ExternalLink(str(folder / "other.hdf5"), "rewards")
        elif kind == "loop":
            file["rewards"], file["costs2"] = h5py.SoftLink("/costs2"), h5py.SoftLink("/rewards")
        elif kind == "huge":
            file.create_dataset("rewards", (1 << 40,), "f8", chunks=(1024,))


@pytest.mark.parametrize(
    ("kind", "told"),
    [
        *((kind, "its rewards is in another file") for kind in ("external", "virtual", "linked")),
        ("loop", "cannot be read, is it whole"),
        ("huge", "does not fit into the memory"),
    ],
)
def test_files_that_lead_elsewhere_or_never_end_are_refused(kind, told, tmp_path, h5py):
    write_hdf5(h5py, tmp_path / "data.hdf5")
    foreign(h5py, tmp_path, kind)
    with pytest.raises(ValueError, match=told):
        read_hdf5(tmp_path / "data.hdf5")


def test_a_file_with_flipped_bits_is_read_or_refused_in_one_line(tmp_path, h5py):
    write_hdf5(h5py, tmp_path / "data.hdf5")
    content, refusals = (tmp_path / "data.hdf5").read_bytes(), []
    for place in range(0, len(content), 97):
        damaged = bytearray(content)
        damaged[place] ^= 0xFF
        (tmp_path / "data.hdf5").write_bytes(damaged)
        try:
            read_hdf5(tmp_path / "data.hdf5")
        except ValueError as error:
            refusals.append(str(error))
    assert refusals
    assert not any("\n" in words for words in refusals)


def test_episodes_without_a_step_and_other_groups_are_passed_over(tmp_path, h5py):
    write_minari(h5py, tmp_path / "data.hdf5")
    whole = read_hdf5(tmp_path / "data.hdf5")
    with h5py.File(tmp_path / "data.hdf5", "a") as file:
        file.create_group("episode_notes")
        empty = file.create_group("episode_12")
        for key, shape in {"observations": (1, 3), "actions": (0, 2), "infos/cost": 1,
                           "infos/cost_hazards": 1}.items():  # fmt: skip
            empty[key] = np.zeros(shape)
        for key in ("rewards", "terminations", "truncations"):
            empty[key] = np.zeros(0)
    assert (read_hdf5(tmp_path / "data.hdf5") == whole).all()


def test_a_damaged_or_empty_file_is_told(tmp_path, h5py):
    path = tmp_path / "data.hdf5"
    write_hdf5(h5py, path)
    path.write_bytes(path.read_bytes()[:3000])
    with pytest.raises(ValueError, match=r"data\.hdf5 cannot be read, is it whole"):
        read_hdf5(path)
    with h5py.File(tmp_path / "none.hdf5", "w") as file:
        for name in ("observations", "actions", "rewards", "costs", "terminals", "timeouts"):
            file[name] = np.zeros((0, 2))
    with pytest.raises(ValueError, match="holds no transitions"):
        read_hdf5(tmp_path / "none.hdf5")


def test_without_h5py_the_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr("safe_rl.extras.find_spec", lambda name: None)
    with pytest.raises(ModuleNotFoundError, match=r"\[hdf5\]"):
        read_hdf5(tmp_path / "data.hdf5")
