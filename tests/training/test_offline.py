"""Learning from a dataset: what is taken of it, what is cloned, and what does not fit."""

import json
from functools import partial

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf, open_dict
from point_mass import Forgetful, PointMass
from point_mass_runs import trainer_of
from run_configs import assert_resumes_exactly, compose_config
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.data import Composite, Unbounded

from safe_rl.algorithms import OffPolicy
from safe_rl.algorithms.dataset import _other_environment
from safe_rl.collectors import Recording, make_collector, read_recording, safe_episodes
from safe_rl.evaluation.episodes import collect_episodes
from safe_rl.models import make_bounded_actor, make_squashed_actor
from safe_rl.objectives import BCLoss
from safe_rl.runs.table import read_table

pytestmark = pytest.mark.long


def head_north(observation):
    """Around the hazard by the north, where it costs as well."""
    return torch.tensor([-0.5, 0.9]).expand(*observation.shape[:-1], 2)


def head_south(observation):
    """Around it by the south, and away: no costs, and a return that is not the best."""
    return torch.tensor([-0.2, -0.7]).expand(*observation.shape[:-1], 2)


def record(folder, *policies, num_steps=20, batches=2):
    recording, number = Recording(folder, PointMass.cost_keys, PointMass().interface), 0
    for policy in policies:
        env = PointMass(4, num_steps)
        module = TensorDictModule(policy, ["observation"], ["action"])
        collector = make_collector(env, module, frames_per_batch=4 * num_steps)
        for batch, _ in zip(collector, range(batches), strict=False):
            recording.write(number, batch)
            number += 1
    return folder


def offline_config(folder, *overrides, algo="bc", limits="{cost: 1}"):
    return compose_config(
        *(f"algo={algo}", "env=PointMass", f"dataset.path={folder}", "logger=none"),
        *("num_envs=4", "frames=1280", "frames_per_batch=160", "model.hidden_sizes=[16]"),
        *("memory.batch_size=64", f"cost_limits={limits}"),
        *overrides,
    )


def recorded_config(*overrides):
    return compose_config(
        *("env=PointMass", "logger=none", "record=true", "num_envs=4", "frames_per_batch=160"),
        *("model.hidden_sizes=[16]", "algo=ppo", *overrides),
    )


def test_what_is_cloned_are_the_safe_episodes(tmp_path):
    data = record(tmp_path / "data", head_north, head_south)
    (tmp_path / "config.yaml").write_text("env: {name: CarGoal1}")
    trainer = trainer_of(offline_config(data), tmp_path / "run")
    assert trainer.algorithm.learns_from == (
        f"Learning from 160 of 320 transitions in {data}: those of whole episodes that keep the "
        "limits. Warning: they are of CarGoal1, and this environment is PointMass."
    )
    trainer.run()
    found = collect_episodes(
        PointMass(4, 20, seed=9), trainer.algorithm.policy, 8, ["cost"], deterministic=True
    )
    assert not found.costs["cost"].any()
    state = PointMass(4, 20, seed=9).reset()
    action = trainer.algorithm.policy(state)["action"]
    torch.testing.assert_close(action, head_south(state["observation"]), atol=0.05, rtol=0)
    table = read_table(tmp_path / "run" / "progress.csv")
    assert table["policy_loss_actor"][-1] < 0.01 < table["policy_loss_actor"][0]
    assert table["policy_num_updates"] == [160] * 8
    assert len(trainer.algorithm.replay_buffer) == 160  # nothing of what it did itself


def test_files_of_another_task_are_named(tmp_path):
    task = OmegaConf.create({"dataset": {"path": "SafetyPointGoal2Gymnasium-v0-200-3442.hdf5"}})
    for name in ("PointGoal2", "SafetyPointGoal2-v0"):
        assert _other_environment(OmegaConf.merge(task, {"env": {"name": name}})) == ""
    told = _other_environment(OmegaConf.merge(task, {"env": {"name": "PointGoal1"}}))
    assert "of SafetyPointGoal2Gymnasium-v0, and this environment is PointGoal1." in told


def test_keys_and_transforms_that_differ_are_named(tmp_path):
    data = record(tmp_path / "data", head_south)
    config = offline_config(data)
    there = OmegaConf.to_container(OmegaConf.masked_copy(config, ["env"]), resolve=True)
    there |= {"transforms": {"scale": {"factor": 0.1}}}
    there["env"]["hazard"] = 0.5

    def told(**keys):
        (tmp_path / "config.yaml").write_text(json.dumps(there))
        with open_dict(config):
            config.update(keys)
        return trainer_of(config, tmp_path / "run").algorithm.learns_from.partition("limits.")[2]

    assert told() == " Warning: they are of a run with other transforms.scale."
    assert told(transforms=there["transforms"]) == ""
    changed = " Warning: they are of a run with other env.hazard."
    assert told(env={**there["env"], "hazard": 0.4}) == changed
    there["transforms"] |= {"stop": {"budgets": {"cost": 1}}}
    about = {**PointMass().interface, "evaluating": True}  # of an evaluation: no episode stopped
    (data / "recording.json").write_text(json.dumps(about))
    assert told(transforms=there["transforms"]) == (
        f"{changed} Warning: transforms=[stop] change what the run collects, but not this "
        "dataset: its observations, rewards and ends are used as they are."
    )


def test_it_resumes_as_if_it_had_never_stopped(tmp_path):
    data = record(tmp_path / "data", head_south)
    make = lambda name, *first: trainer_of(offline_config(data, *first), tmp_path / name)  # noqa: E731
    assert assert_resumes_exactly(make, tmp_path, "frames=640").algorithm.lost_on_resume == ""


@pytest.mark.parametrize("algo", ["ppo_lagrangian", "sac_lagrangian"])
def test_a_run_that_is_recorded_can_be_learned_from(algo, tmp_path):
    trainer = trainer_of(recorded_config(f"algo={algo}", "frames=480"), tmp_path / "run")
    collected, update = [], trainer.accounting.update
    trainer.accounting.update = lambda batch: (collected.append(batch.clone()), update(batch))[1]
    trainer.run()
    found, expected = read_recording(tmp_path / "run" / "transitions"), torch.cat(collected, -1)
    for key in (*("observation", "action"), *(("next", k) for k in ("reward", "cost", "done"))):
        assert torch.equal(found[key], expected[key])
    clone = trainer_of(
        offline_config(tmp_path / "run" / "transitions", "frames=160", limits="{cost: 25}"),
        tmp_path / "clone",
    )
    clone.run()
    # rows begin at different points of their first episode: only whole ones are taken
    assert 0 < len(clone.algorithm.replay_buffer) <= 480
    actions = torch.cat(list(clone.algorithm.replay_buffer.minibatches(4)))["action"]
    assert actions.abs().max() <= 1


def test_a_resumed_run_records_again_what_it_repeats(tmp_path):
    trainer_of(recorded_config("frames=480"), tmp_path / "whole").run()
    trainer_of(recorded_config("frames=160"), tmp_path / "halves").run()
    # of a process that was killed before it could write a checkpoint, and was to be a longer run
    ahead = tmp_path / "halves" / "transitions"
    for number in (1, 2, 3):
        Recording(ahead, []).write(number, PointMass(4).rollout(1))
    resumed = trainer_of(recorded_config("frames=480"), tmp_path / "halves")
    assert resumed.resume()
    resumed.run()
    whole, halves = (read_recording(tmp_path / n / "transitions") for n in ("whole", "halves"))
    assert whole.shape == halves.shape == (4, 120)
    assert torch.equal(whole["observation"], halves["observation"])


@pytest.mark.parametrize(("kind", "staggered"), [(PointMass, "true"), (Forgetful, "null")])
def test_whole_episodes_of_a_recording_are_those_of_the_table(kind, staggered, tmp_path):
    """Not those that began before it, nor those that a run left open when it was interrupted."""

    def build(frames):
        keys = [f"frames={frames}", "frames_per_batch=200", f"staggered_starts={staggered}"]
        config = recorded_config(*keys)
        return trainer_of(config, tmp_path, kind(4, 20, config.seed))

    build(600).run()
    resumed = build(1200)
    assert resumed.resume()
    resumed.run()
    steps, table = read_recording(tmp_path / "transitions"), read_table(tmp_path / "progress.csv")
    assert steps.shape == (4, 300)
    number = sum(table["episodes"])
    assert steps["next", "done"].sum() == number + 4  # and parts of four others
    found = safe_episodes(steps, {})
    assert found.shape == (1, 20 * number)
    costs = sum(n * c for n, c in zip(table["episodes"], table["episode_cost"], strict=True))
    assert found["next", "cost"].double().sum() == pytest.approx(costs)


def test_recording_may_begin_within_episodes(tmp_path):
    def build(frames, record):
        keys = [f"frames={frames}", f"record={record}", "frames_per_batch=200"]
        return trainer_of(recorded_config(*keys, "staggered_starts=null"), tmp_path)

    build(200, "false").run()
    resumed = build(600, "true")
    assert resumed.resume()
    resumed.run()
    steps = read_recording(tmp_path / "transitions")
    assert steps["partial"].nonzero().tolist() == [[row, 0, 0] for row in range(4)]
    # of 100 steps 10 belong to the episodes before, and 10 to what is still open
    assert safe_episodes(steps, {}).shape == (1, 4 * 80)


def test_any_algorithm_may_begin_with_a_dataset(tmp_path):
    data = record(tmp_path / "data", head_north, head_south)
    keys = ["exploration.random_steps=0", "policy_update.updates_per_step=0.05", "memory.n_steps=3"]
    trainer = trainer_of(offline_config(data, *keys, algo="sac"), tmp_path / "run")
    assert len(trainer.algorithm.replay_buffer) == 320
    before = len(trainer.algorithm.replay_buffer)
    trainer.epoch(iter(trainer.collector))
    # the last three of each row wait for what follows them
    assert len(trainer.algorithm.replay_buffer) == before + 4 * 37
    assert "dataset alone" in trainer.algorithm.lost_on_resume
    # with nothing of its own to learn from, nothing is done at random
    keys += ["dataset.alone=true", "exploration.random_steps=10000"]
    alone = trainer_of(offline_config(data, *keys, algo="sac_lagrangian"), tmp_path / "alone")
    assert not alone.algorithm.policy.is_random
    assert alone.algorithm.lost_on_resume == ""
    assert alone.epoch(iter(alone.collector))["policy_num_updates"] == 8
    assert not alone.algorithm.policy.is_random
    assert len(alone.algorithm.replay_buffer) == before


def test_the_loss_is_the_mean_squared_difference():
    actor = make_bounded_actor(3, -torch.ones(2), torch.ones(2), hidden_sizes=[8])
    steps = TensorDict(observation=torch.randn(7, 3), action=torch.rand(7, 2), batch_size=[7])
    steps["collector", "mask"] = torch.arange(7) < 5
    loss = BCLoss(actor)(steps)["loss_actor"]
    chosen = actor(steps.clone())["action"].detach().numpy()
    expected = np.square(chosen - steps["action"].numpy())[:5].mean()
    assert loss.item() == pytest.approx(expected, rel=1e-6)
    loss.backward()
    assert all(p.grad is not None for p in actor.parameters())
    moved = BCLoss(actor)
    moved.set_keys(action=("expert", "action"))
    steps["expert", "action"] = steps.pop("action")
    torch.testing.assert_close(moved(steps)["loss_actor"], loss)
    with pytest.raises(ValueError, match=r"deterministic.*, not \['loc', 'scale'"):
        BCLoss(make_squashed_actor(3, -torch.ones(2), torch.ones(2), hidden_sizes=[8]))


@pytest.mark.parametrize(
    ("algo", "key", "value"),
    [
        ("bc", ("next", "cost"), torch.nan),
        ("bc", "action", torch.inf),
        ("sac_lagrangian", ("next", "reward"), torch.nan),
        ("bc", ("next", "cost"), -1.0),
    ],
)
def test_wrong_numbers_are_refused(algo, key, value, tmp_path):
    batch = PointMass(2, 20).rollout(20)
    batch[key][1, 3:5] = value
    Recording(tmp_path / "data", PointMass.cost_keys).write(0, batch)
    name = key if isinstance(key, str) else key[1]
    with pytest.raises(ValueError, match=f"{name}' is (not finite|below 0) in 2 of 40"):
        OffPolicy.from_config(
            offline_config(tmp_path / "data", limits="{cost: 25}", algo=algo), PointMass(2)
        )


class Other(PointMass):
    def __init__(self, *shape):
        super().__init__(2)
        self.observation_spec = Composite(observation=Unbounded((2, *shape)), shape=[2])


@pytest.mark.parametrize(
    ("overrides", "env", "words"),
    [
        (["dataset.path=null"], PointMass, r"dataset\.path is missing: algo=bc"),
        (["dataset.path=/no/where"], PointMass, "/no/where: there is no such recording"),
        (["+limit=0"], PointMass, "of its 160 transitions 0 are taken in whole"),
        (["memory.capacity=80"], PointMass, "room for them: memory.capacity=80"),
        (["memory.batch_size=512"], PointMass, r"holds 160 .*a minibatch of 512 \(memory.batch"),
        ([], partial(Other, 5), "its observations are 4 numbers, those of this environment 5"),
        (["model=cnn"], partial(Other, 40, 40, 3), "has vectors as observations, and this env"),
    ],
)
def test_what_does_not_fit_is_said(overrides, env, words, tmp_path):
    data = record(tmp_path / "data", head_north)
    limits = "{cost: 0}" if "+limit=0" in overrides else "{cost: 20}"
    config = offline_config(data, *overrides, limits=limits)
    with pytest.raises((ValueError, FileNotFoundError), match=words):
        OffPolicy.from_config(config, env())


def test_costs_that_a_dataset_lacks_are_named(tmp_path):
    Recording(tmp_path / "data", ["cost"]).write(0, PointMass(2, 20).rollout(20))
    for algo, why in (
        ("bc", "which cost_limits names"),
        ("sac_lagrangian", "which is learned from"),
    ):
        config = offline_config(tmp_path / "data", algo=algo, limits="{cost_north: 3}")
        with pytest.raises(ValueError, match=f"has no cost_north, {why}"):
            OffPolicy.from_config(config, PointMass(2))
