"""Datasets mean the same in every family: a clone does in the raw environment what they say."""

import functools
from types import SimpleNamespace

import gymnasium
import gymnasium_envs  # noqa: F401, registers Tank-v0
import numpy as np
import pytest
import torch
from run_configs import compose_config
from torchrl.checkpoint import CheckpointError

import safe_rl
from safe_rl.algorithms import OffPolicy
from safe_rl.algorithms.dataset import _smaller_actions
from safe_rl.collectors import Recording, read_columns, read_recording, safety_gymnasium_columns
from safe_rl.envs import make_env

h5py = pytest.importorskip("h5py", reason="comes with the extra hdf5")


TANK = {"_target_": "safe_rl.envs.gymnasium.make_gymnasium", "id": "Tank-v0"}
make_tank = functools.partial(make_env, TANK, num_envs=2)
GYMNASIUM = {"env": "gymnasium", "env.id": "Tank-v0"}
FAMILIES = {
    "bounds [0, 2]": ("Tank-v0", GYMNASIUM, 0.5),
    "velocity": ("SafeHumanoidVelocity-v0", {"env": "SafeHumanoidVelocity"}, 0.3),
    "safety gym": ("Safexp-PointGoal1-v0", {"env": "PointGoal1", "env.num_steps": 200}, 0.6),
}
SMALL = {"num_envs": 2, "frames_per_batch": 40, "frames": 40, "logger": "none", "algo": "ppo"}


def write_episodes(path, name, action, episodes=12, steps=200):
    """An HDF5 file of constant actions in an environment's own units; returns all returns."""
    env, columns, returns = gymnasium.make(name), {}, np.zeros(episodes)
    action = np.full(env.action_space.shape, action, np.float32)
    for episode in range(episodes):
        before, _ = env.reset(seed=episode)
        for step in range(1, steps + 1):
            after, reward, terminated, truncated, info = env.step(action)
            cost = info.get("cost", info.get("cost_speed"))
            row = {"observations": before, "next_observations": after, "actions": action,
                   "rewards": reward, "costs": cost, "terminals": terminated,
                   "timeouts": truncated or (step == steps and not terminated)}  # fmt: skip
            for key, value in row.items():
                columns.setdefault(key, []).append(value)
            before, returns[episode] = after, returns[episode] + reward
            if row["terminals"] or row["timeouts"]:
                break
    with h5py.File(path, "w") as file:
        for key, values in columns.items():
            file[key] = np.array(values)
    return returns


def clone(folder, data, settings, **others):
    small = {"frames": 1600, "frames_per_batch": 400, "num_envs": 4, "logger": "none"}
    network = {"model.hidden_sizes": [16], "memory.batch_size": 32, "cost_limits": {"cost": 1e6}}
    return safe_rl.train(
        algo="bc", directory=folder, **small, **network, **settings, **others,
        **{"dataset.path": str(data)},
    )  # fmt: skip


@pytest.mark.long
@pytest.mark.parametrize("family", FAMILIES)
def test_a_clone_does_in_the_raw_environment_what_the_file_says(family, tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    name, settings, action = FAMILIES[family]
    returns = write_episodes(tmp_path / "data.hdf5", name, action)
    run = clone(tmp_path / "run", "~/data.hdf5", settings)
    found = run.evaluate(episodes=12, record=True)
    tolerance = 0.02 * abs(returns.mean()) + 3 * returns.std() * (2 / 12) ** 0.5
    assert abs(found.estimates["episode_return"].value - returns.mean()) <= tolerance
    steps = read_recording(run.directory / "evaluation.transitions")
    bounds = read_columns(run.directory / "evaluation.transitions")["actions"].values()
    low, high, own_low, own_high = map(torch.tensor, bounds)
    own = own_low + (steps["action"].clamp(low, high) - low) / (high - low) * (own_high - own_low)
    assert own.median().item() == pytest.approx(action, abs=0.05)


def learner(path, env, *overrides, name="PointGoal1"):
    config = compose_config(
        *("algo=bc", f"env={name}", f"dataset.path={path}", "cost_limits={cost: 1e6}"),
        *("model.hidden_sizes=[8]", "memory.batch_size=4", *overrides),
    )
    return OffPolicy.from_config(config, env)


def learned(*given, **named):
    return torch.cat([*learner(*given, **named).replay_buffer.minibatches(20)])


def learned_actions(path, env):
    steps = learned(path, env, "env.id=Tank-v0", name="gymnasium")
    return steps["action"].unique().tolist()


@pytest.mark.parametrize(
    ("action", "told"),
    [
        (1.0, None),
        (2.000001, None),
        (50.0, r"100\.0% of its actions.*from 50 to 50, and the bounds are 0 and 2"),
        (-0.5, "from -0.5 to -0.5, and the bounds are 0 and 2"),
    ],
)
def test_actions_of_a_file_are_in_the_environment_s_units(action, told, tmp_path):
    write_episodes(tmp_path / "data.hdf5", "Tank-v0", 1.0)
    with h5py.File(tmp_path / "data.hdf5", "a") as file:
        file["actions"][...] = action
        numbers = file["rewards"][:].astype(">f4")  # of a machine with the other order of bytes
        del file["rewards"]
        file["rewards"] = numbers
    env = make_tank()
    if told is None:
        assert learned_actions(tmp_path / "data.hdf5", env) == [round(action - 1, 3)]
        return
    with pytest.raises(ValueError, match=told):
        learned_actions(tmp_path / "data.hdf5", env)


def test_a_warning_names_actions_that_may_have_been_scaled():
    actions = torch.tensor([[[0.9, -0.2], [-1.0, 0.4]]])
    for width, is_named in ((2.0, True), (1.0, False)):
        env = SimpleNamespace(
            action_bounds=(torch.tensor([-width, 0.0]), torch.tensor([width, 1.0]))
        )
        assert ("rescale them if they were scaled" in _smaller_actions(actions, env)) == is_named
        assert _smaller_actions(1.2 * actions, env) == ""


def mark_ends(path, terminals, timeouts=()):
    with h5py.File(path, "a") as file:
        file["terminals"][...] = np.isin(np.arange(60), terminals)
        file["timeouts"][...] = np.isin(np.arange(60), timeouts)


LAST = (19, 39, 59)  # steps of three episodes


@pytest.mark.parametrize(
    ("terminals", "timeouts"),
    [
        (LAST, LAST),
        ((9, *LAST), ()),  # one ends early
        ((9, *LAST), LAST),  # time-outs are marked as both
        (LAST[:2], ()),  # nor is the last one marked
    ],
)
def test_time_outs_that_a_file_calls_terminations_are_refused(terminals, timeouts, tmp_path):
    write_episodes(tmp_path / "data.hdf5", "Tank-v0", 1.0, episodes=3)
    mark_ends(tmp_path / "data.hdf5", terminals, timeouts)
    with pytest.raises(ValueError, match="episodes of 20 steps terminate, so these are time-outs"):
        learned_actions(tmp_path / "data.hdf5", make_tank())


def test_a_file_that_lacks_the_ends_of_its_episodes_is_refused(tmp_path):
    write_episodes(tmp_path / "data.hdf5", "Tank-v0", 1.0, episodes=3)
    mark_ends(tmp_path / "data.hdf5", (9,))
    with h5py.File(tmp_path / "data.hdf5", "a") as file:
        del file["next_observations"]
    with pytest.raises(ValueError, match=r"50 steps without an end, and episodes .* at most 20"):
        learned_actions(tmp_path / "data.hdf5", make_tank())


@pytest.mark.parametrize("costs", [[*range(8)], [0, 2] * 4], ids=["of episodes", "of kinds"])
def test_costs_that_are_sums_are_refused(costs, tmp_path):
    write_episodes(tmp_path / "data.hdf5", "Safexp-PointGoal1-v0", 0.5, episodes=1, steps=8)
    with h5py.File(tmp_path / "data.hdf5", "a") as file:
        file["costs"][...] = costs
    with pytest.raises(ValueError, match=rf"its cost is up to {max(costs)} in a step, that"):
        learned(tmp_path / "data.hdf5", make_env("PointGoal1", num_envs=1, seed=0))


def test_recorded_actions_are_those_of_the_policy(tmp_path):
    """A policy drew actions beyond its bounds, and the environment clipped them."""
    env = make_tank()
    steps = env.rollout(20)
    steps["action"].fill_(-1.5)
    assert learned_actions(recorded(tmp_path / "known", env, steps), env) == [-1.0]
    steps["action"].fill_(0.25)  # of an environment whose policies act in its own units
    about = {"actions": {"low": [0.0], "high": [2.0], "own_low": [0.0], "own_high": [2.0]}}
    Recording(tmp_path / "other", env.cost_keys, about).write(0, steps)
    assert learned_actions(tmp_path / "other", env) == [-0.75]
    with pytest.raises(ValueError, match=r"held for 4 step\(s\), and here for 1"):
        learned_actions(recorded(tmp_path / "held", env, steps, steps_per_decision=4), env)


def recorded(folder, env, steps, **interface):
    Recording(folder, env.cost_keys, env.interface | interface).write(0, steps)
    return folder


def test_columns_are_taken_by_their_names(tmp_path):
    env = make_env("PointGoal1", num_envs=1, seed=0)
    write_episodes(tmp_path / "own.hdf5", "Safexp-PointGoal1-v0", 0.5, episodes=1, steps=8)
    with h5py.File(tmp_path / "own.hdf5", "a") as file:
        seen, names = file["observations"][:], env.column_names
        expected = torch.from_numpy(seen)
        theirs = safety_gymnasium_columns(names)
        order = [names.index(name) for name in theirs]
        for key in ("observations", "next_observations"):
            file[key][...] = file[key][:][:, order]
    with pytest.raises(ValueError, match=r"columns of its observations leave the bounds.*safety_g"):
        learned(tmp_path / "own.hdf5", env)

    def check(path, *overrides):
        found = learned(path, env, *overrides)["observation"]
        assert {tuple(row) for row in found.tolist()} <= {tuple(row) for row in expected.tolist()}

    check(tmp_path / "own.hdf5", "dataset.columns=safety_gymnasium")
    write_episodes(tmp_path / "ours.hdf5", "Safexp-PointGoal1-v0", 0.5, episodes=1, steps=8)
    with pytest.raises(ValueError, match="Only files of Safety-Gymnasium and DSRL need dataset"):
        learned(tmp_path / "ours.hdf5", env, "dataset.columns=safety_gymnasium")
    (tmp_path / "own.hdf5").rename(tmp_path / "SafetyPointGoal1Gymnasium-v0-65-2022.hdf5")
    with pytest.raises(ValueError, match=r"is of SafetyPointGoal1Gymnasium-v0, whose columns"):
        learned(tmp_path / "SafetyPointGoal1Gymnasium-v0-65-2022.hdf5", env)
    path = (tmp_path / "SafetyPointGoal1Gymnasium-v0-65-2022.hdf5").rename(tmp_path / "a.hdf5")
    for names in (theirs, np.array(theirs, dtype="S")):
        with h5py.File(path, "a") as file:
            file.attrs["observation_columns"] = names
        check(path)
    with h5py.File(path, "a") as file:
        renamed = [name.replace("vases", "gremlins") for name in theirs]
        file.attrs["observation_columns"] = renamed
    with pytest.raises(ValueError, match="have gremlins_lidar, where this environment has vases_l"):
        learned(path, env)


@pytest.mark.parametrize(
    ("name", "order"),
    [
        ("PointGoal1", "accelerometer velocimeter gyro magnetometer goal hazards vases"),
        ("PointButton2", "accelerometer velocimeter gyro magnetometer buttons goal hazards grem"),
        (
            "CarPush1",
            "accelerometer velocimeter gyro magnetometer ballangvel_rear ballquat_rear "
            "goal hazards pillars box",
        ),
        (
            "DoggoGoal0",
            "accelerometer velocimeter gyro magnetometer touch_ankle_1a touch_ankle_2a "
            "touch_ankle_3a touch_ankle_4a touch_ankle_1b touch_ankle_2b touch_ankle_3b "
            "touch_ankle_4b jointvel_hip_1_z jointvel_hip_2_z jointvel_hip_3_z jointvel_hip_4_z "
            "jointvel_hip_1_y jointvel_hip_2_y jointvel_hip_3_y jointvel_hip_4_y jointvel_ankle_1 "
            "jointvel_ankle_2 jointvel_ankle_3 jointvel_ankle_4 jointpos_hip_1_z jointpos_hip_2_z "
            "jointpos_hip_3_z jointpos_hip_4_z jointpos_hip_1_y jointpos_hip_2_y jointpos_hip_3_y "
            "jointpos_hip_4_y jointpos_ankle_1 jointpos_ankle_2 jointpos_ankle_3 jointpos_ankle_4 "
            "goal",
        ),
    ],
)
def test_the_order_of_safety_gymnasium(name, order):
    """As its source has it: bases/base_agent.py, bases/base_task.py and the tasks of 1.0."""
    names = safety_gymnasium_columns(make_env(name, num_envs=1, seed=0).column_names)
    kinds = [*dict.fromkeys(name.partition("[")[0] for name in names)]
    assert len(kinds) == len(order.split())
    assert all(map(str.startswith, kinds, order.split()))


@pytest.mark.long
def test_paths_may_have_any_characters(tmp_path):
    folder = tmp_path / "Läufe [1] (ä, b)={c}"
    first = safe_rl.train("PointGoal1", directory=folder, record=True, **SMALL)
    second = safe_rl.train("PointGoal1", directory=tmp_path / "b", init_from=folder, **SMALL)
    assert second.table["steps"] == [40]
    env = make_env("PointGoal1", num_envs=2, seed=0)
    path = str(first.directory / "transitions").replace("'", "\\'")
    learned(f"'{path}'", env, "dataset.safe_episodes=false")


def test_a_file_without_names_is_used_with_a_warning(tmp_path):
    path, words = tmp_path / "data" / "main_data.hdf5", ("env.id=Tank-v0",)
    path.parent.mkdir()
    write_episodes(path, "Tank-v0", 0.5)
    env = make_tank()
    told = learner(tmp_path, env, *words, name="gymnasium").learns_from  # as Minari has it
    assert "main_data.hdf5: " in told
    assert "not name the columns" in told
    assert "transforms" not in told
    scale = "+transforms.scale={_target_: torchrl.envs.RewardScaling, loc: 0, scale: 0.01}"
    told = learner(path, env, *words, scale, name="gymnasium").learns_from
    assert "Warning: transforms=[scale] change what the run collects, but not this dat" in told


@pytest.mark.long
def test_a_policy_is_refused_where_other_sensors_have_its_size(tmp_path):
    run = safe_rl.train("PointGoal1", directory=tmp_path / "first", **SMALL)
    gremlins = {"observe_vases": False, "observe_gremlins": True, "gremlins_num": 2}
    for keys, told in (
        (gremlins, "they have vases_lidar, where this environment has gremlins_lidar"),
        ({"lidar_type": "natural"}, "lidar_type is pseudo, and that of this environment natural"),
    ):
        changed = {f"env.{key}": value for key, value in keys.items()}
        begun = SMALL | changed | {"directory": tmp_path / "b", "init_from": run.directory}
        with pytest.raises(CheckpointError, match=told):
            run.evaluate(episodes=1, env=keys)
        with pytest.raises(CheckpointError, match=told):
            safe_rl.train("PointGoal1", **begun)
