"""Starting from trained networks: what is taken over, and what does not fit."""

from types import SimpleNamespace

import pytest
import torch
from omegaconf import OmegaConf
from point_mass_runs import point_mass_trainer
from torchrl.checkpoint import CheckpointError

from safe_rl.models import QEnsemble, make_bounded_actor
from safe_rl.runs.checkpoints import CheckpointStore
from safe_rl.training.building import begin_from, estimated
from safe_rl.training.state import Progress

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run of two epochs, which no test changes."""
    trainer = point_mass_trainer(tmp_path_factory.mktemp("trained") / "first", "frames=320")
    trainer.run()
    return trainer


def same(first, second):
    pairs = zip(first.state_dict().values(), second.state_dict().values(), strict=True)
    return all(torch.equal(a, b) for a, b in pairs)


def make_fresh(trained, *overrides):
    return point_mass_trainer(trained.writer.run.directory.parent / "second", "seed=1", *overrides)


def take_over(trained, *overrides):
    fresh = make_fresh(trained, *overrides)
    assert not same(fresh.algorithm.networks["actor"], trained.algorithm.actor)
    config = OmegaConf.to_container(fresh.writer.config) | {
        "init_from": trained.writer.run.directory
    }
    return fresh, begin_from(fresh.algorithm, config)


def refuse(algorithm, source, match):
    with pytest.raises(CheckpointError, match=match):
        begin_from(algorithm, {"init_from": source})


def test_all_networks_are_taken_over_and_nothing_else(trained):
    fresh, taken = take_over(trained)
    assert taken == ["actor", "critic", "cost_critic"]
    for name in taken:
        theirs = trained.algorithm.networks[name]
        assert same(fresh.algorithm.networks[name], theirs)
    assert fresh.progress == Progress()
    assert not fresh.algorithm.policy_update.optimizer.state
    # the policy that collects has the weights, too
    batch = next(iter(fresh.collector))
    expected = trained.algorithm.actor.get_dist(batch)
    assert torch.allclose(batch["loc"], expected.base_dist.loc, atol=1e-6)


@pytest.mark.parametrize(
    "other",
    [
        *("algo=ppo", "cost_limits={cost_hazards: 1}", "cost_limits={cost: 1, cost_north: 2}"),
        "risk=cvar",
    ],
)
def test_the_cost_critic_stays_new_where_it_would_estimate_something_else(trained, other):
    assert take_over(trained, other)[1] == ["actor", "critic"]
    risk = {"_target_": "safe_rl.objectives.CVaR"}
    assert estimated({"risk": risk | {"tail": 0.1}}) != estimated({"risk": risk | {"tail": 0.5}})


def test_actions_of_another_meaning_are_told(trained, capsys):
    here = trained.env.interface
    other = {**here["actions"], "own_low": [-6.0, -6.0]}
    fresh = make_fresh(trained).algorithm
    for changes in ({}, {"steps_per_decision": 2}, {"actions": other}):
        begin_from(fresh, {"init_from": trained.writer.run.directory}, here | changes)
    told = capsys.readouterr().out.splitlines()
    assert told == [
        "Warning: an action of init_from lasts 1 step(s), and here 2.",
        "Warning: actions of init_from have the bounds [[-1.0, -1.0], [1.0, 1.0]], and here "
        "[[-6.0, -6.0], [1.0, 1.0]].",
    ]


@pytest.mark.parametrize(
    ("override", "message"),
    [
        (
            "model.hidden_sizes=[8, 8]",
            r"\(\[16, 4\]\) from .*\(\[8, 4\]\).*Set model\.",
        ),
        ("model.input_scale={position: 0.5}", "Missing key.*Set model"),
        ("model.normalise=10", "Missing key.*Set model"),
    ],
)
def test_other_sizes_are_named(trained, override, message):
    refuse(make_fresh(trained, override).algorithm, trained.writer.run.directory, message)


def test_what_a_run_has_not_learned_is_named(tmp_path):
    actor = make_bounded_actor(3, -torch.ones(2), torch.ones(2), hidden_sizes=[8])
    clone = CheckpointStore(tmp_path, {"actor": actor}, keep_last=1).save(10)
    networks = {"actor": actor, "critic": QEnsemble(3, 2, hidden_sizes=[8], num_networks=2)}
    algorithm = SimpleNamespace(networks=networks, cost_keys=[], cost_networks=[])
    refuse(algorithm, clone, "torchrl has no critic. init_from needs")


def test_a_folder_without_a_checkpoint(trained, tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    for place in (tmp_path, "~"):
        with pytest.raises(CheckpointError, match=r"init_from=.*no checkpoint"):
            begin_from(trained.algorithm, {"init_from": place})
