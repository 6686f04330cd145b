"""The script with TorchRL's own collector and buffer, beside the same run by the package."""

import math

import replay_buffer
from point_mass import PointMass
from run_configs import compose_config

from safe_rl.algorithms.algorithm_contract import find_algorithm
from safe_rl.collectors import EpisodeAccounting

SIZES = ["--num-envs=4", "--frames=240", "--frames-per-batch=80", "--updates-per-batch=20"]
# numbers of the script, and no gradient steps
SAME = (
    "env=PointMass", "algo=sac_lagrangian", "limits=null", "lagrangian=replay",
    "lagrangian.init=0", "lagrangian.kp=0.1", "lagrangian.ki=0.05", "lagrangian.saturation=0.5",
    "lagrangian.highest=5", "cost_limits={cost: 1}", "policy_update.updates_per_step=1e-9",
)  # fmt: skip


def test_lambda_has_the_scale_that_it_has_in_the_package(monkeypatch, capsys):
    """The same batches give the same λ, and the same weight of a cost beside a reward."""
    config = compose_config(*SAME)
    algorithm = find_algorithm(config).from_config(config, PointMass(4, 20))
    expected, losses = [], []

    class Both(EpisodeAccounting):
        def update(self, batch):
            episodes = super().update(batch)
            row = algorithm.learn(batch.clone(), episodes)
            expected.append((row["multiplier_cost"], algorithm.policy_update.loss))
            return episodes

    def make_loss(*arguments):
        losses.extend(made := build(*arguments))
        return made

    build = replay_buffer.make_loss
    monkeypatch.setattr(replay_buffer, "EpisodeAccounting", Both)
    monkeypatch.setattr(replay_buffer, "make_loss", make_loss)
    monkeypatch.setattr(
        replay_buffer, "SafetyGymEnv", lambda name, num_envs, seed: PointMass(num_envs, 20, seed)
    )
    rows = replay_buffer.main(["--limit=1", *SIZES])
    assert [row["episodes"] for row in rows] == [4, 4, 4]
    assert [row["multiplier"] for row in rows] == [value for value, _ in expected]
    assert rows[-1]["multiplier"] > 0
    ours, theirs = losses[0], expected[-1][1]
    assert ours.reward_unit == theirs.reward_unit != 1
    assert ours.cost_unit == theirs.cost_unit
    assert all(math.isfinite(row["loss_qvalue"]) for row in rows)
    assert capsys.readouterr().out.count("J_r") == 3
