"""The example of a risk measure of one's own, and losses of TorchRL: definitions and whole runs."""

import math

import custom_risk
import pytest
import torch
from omegaconf import OmegaConf
from point_mass_runs import point_mass_trainer
from run_configs import CONF

from safe_rl import trust
from safe_rl.algorithms import Constraints
from safe_rl.checks import SettingError
from safe_rl.evaluation.settings import certificate_options
from safe_rl.objectives import PPOLoss
from safe_rl.runs.run import Run
from safe_rl.runs.table import read_table
from safe_rl.training.train import certify_finished
from safe_rl.trust import allow

EXAMPLES = CONF.parent / "examples"
allow("custom_risk")


def test_measured_costs_sum_to_mean_and_semideviation():
    costs = torch.rand(6, 10, 1)
    ends = torch.zeros(6, 10, dtype=torch.bool)
    ends[:, -1] = True
    totals = costs.sum(1)
    risk = custom_risk.UpperSemideviation(torch.tensor([1.0]), weight=0.5, decay=0.0)
    measured = risk(costs, ends, torch.zeros(6, 1), totals).costs.sum(1)
    expected = totals.mean() + 0.5 * (totals - totals.mean()).clamp_min(0).mean()
    torch.testing.assert_close(measured.mean(), expected)


def test_it_trains_with_several_costs(tmp_path):
    trainer = point_mass_trainer(
        tmp_path, f"hydra.searchpath=[file://{EXAMPLES / 'conf'}]", "algo=p3o",
        "risk=semideviation", "cost_limits={cost_hazards: 1, cost_north: 0.5}",
    )  # fmt: skip
    trainer.run()
    table = read_table(tmp_path / "progress.csv")
    for key, limit in (("cost_hazards", 1), ("cost_north", 0.5)):
        expected = [estimate - limit for estimate in table[f"estimate_{key}"]]
        assert table[f"violation_{key}"] == pytest.approx(expected, abs=1e-5)
    run, said = Run(tmp_path), []
    certify_finished(run, run.config, 25, stopped_by=None, again=str, say=said.append)
    assert said[0].startswith("Not certified: there is no test for limits on UpperSemideviation.")
    own = OmegaConf.merge(run.config, {"risk": {"tail": 0.2}})
    assert certificate_options(own).tail == 1.0


class ReadsCosts(PPOLoss):
    extra_in_keys = (("next", "cost"),)

    def _surrogates(self, tensordict, log_weight):
        assert tensordict["next", "cost"].shape == tensordict["advantage"].shape
        return super()._surrogates(tensordict, log_weight)


def test_a_loss_gets_the_entries_that_it_names(tmp_path, monkeypatch):
    monkeypatch.setitem(trust._ROOMS, __name__, None)
    trainer = point_mass_trainer(tmp_path, "algo=ppo", f"loss._target_={__name__}.ReadsCosts")
    assert trainer.epoch(iter(trainer.collector))["policy_num_steps"] > 0


@pytest.mark.parametrize("name", ["A2CLoss", "ClipPPOLoss"])
def test_a_run_learns_with_a_loss_of_torchrls(name, tmp_path, monkeypatch):
    """What is not one number for each of its constraints is logged as a scalar."""
    monkeypatch.setitem(trust._ROOMS, "torchrl.objectives", None)
    keys = ("algo=ppo", f"loss._target_=torchrl.objectives.{name}")
    with pytest.raises(SettingError, match="this one reports none: use max_kl=null and adapt"):
        point_mass_trainer(tmp_path / "kl", *keys).run()
    free = ("policy_update.max_kl=null", "policy_update.adapt_rate=null")
    trainer = point_mass_trainer(tmp_path, *keys, *free)
    row = trainer.epoch(iter(trainer.collector))
    assert math.isfinite(row["policy_loss_critic"])
    assert ("policy_explained_variance" in row) == (name != "A2CLoss")


def test_what_is_neither_a_number_nor_one_for_each_constraint_is_named():
    with pytest.raises(ValueError, match=r"'policy_own' has the shape \[3\].*each of 2"):
        Constraints({"cost_a": 1.0, "cost_b": 1.0}).column("policy_own", torch.zeros(3))
