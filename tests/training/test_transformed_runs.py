"""Runs on a problem that transforms change: what they log, learn from, resume and evaluate."""

import sys
from pathlib import Path

import pytest
from commands import status_of
from point_mass import Forgetful, PointMass
from point_mass_runs import trainer_of
from run_configs import assert_resumes_exactly, off_policy_config, point_mass_config
from torchrl.envs.transforms import StepCounter

from safe_rl.cli.evaluate import main as evaluate_main
from safe_rl.envs.transforms import transform_env
from safe_rl.evaluation import EvaluationOptions, evaluate
from safe_rl.evaluation.loading import transforms_of
from safe_rl.runs.table import read_table

pytestmark = pytest.mark.long


def make_trainer(directory, *overrides, make_config=point_mass_config):
    config = make_config(*overrides)
    env = PointMass(config.num_envs, seed=config.seed)
    changed = transform_env(env, transforms_of(config), evaluating=False)
    return trainer_of(config, directory, changed)


@pytest.mark.parametrize(
    "transforms",
    [
        "simmer,early_termination",
        "sensor_noise,action_delay",
        "simmer,observed_costs,action_repeat",
    ],
    ids=["budgets", "noise", "repeats"],
)
def test_an_interrupted_run_resumes_exactly(tmp_path, transforms):
    # 50 steps a batch: episodes of 20 are open at every checkpoint
    options = ["algo=ppo", "cost_limits={cost: 2}", "frames_per_batch=200"]
    options += [f"transforms=[{transforms}]"]
    options += ["transforms.simmer.steps=150"] * ("simmer" in transforms)
    options += ["transforms.action_repeat.k=5"] * ("action_repeat" in transforms)
    make = lambda name, *more: make_trainer(tmp_path / name, *options, "frames=1200", *more)  # noqa: E731
    assert_resumes_exactly(make, tmp_path, "frames=600")


def test_everything_counts_steps_of_the_environment_where_actions_are_held(tmp_path):
    counts = ["frames_per_batch=160", "exploration.random_steps=320", "num_envs=4"]
    counts += ["policy_update.updates_per_step=0.1", "memory.batch_size=8", "memory.n_steps=1"]
    counts += ["limits.free_steps=160", "limits.descent_steps=160", "cost_limits={cost: 1}"]
    counts += ["frames=640"]
    options = ["algo=sac_lagrangian", "transforms=[action_repeat]", *counts]
    trainer = make_trainer(tmp_path, *options, make_config=off_policy_config)
    starts = trainer.env.get_state()["step_count"][:, 0].tolist()
    assert starts == [0, 4, 8, 12]  # of 20 steps: 0, 5, 10, 15 rounded down to decisions
    batch = next(iter(trainer.collector))
    assert batch.shape == (4, 10)
    trainer = make_trainer(tmp_path / "run", *options, make_config=off_policy_config)
    trainer.run()
    table = read_table(tmp_path / "run/progress.csv")
    assert table["steps"] == [160, 320, 480, 640]
    assert table["episode_length"] == [20.0] * 4
    assert table["policy_num_updates"] == [0.0, 16.0, 16.0, 16.0]
    # free until step 160, then down: there at 320
    assert table["target_cost"][0] > table["estimate_cost"][0]
    assert table["target_cost"][1] < 1.0
    # of a policy that acts at random alone, the estimate is what episodes cost
    rate, length = table["cost_rate"][0], table["episode_length"][0]
    assert table["estimate_cost"][0] == pytest.approx(rate * length)


def test_steps_that_a_last_decision_does_not_take_are_not_counted(tmp_path):
    # episodes of 20 steps are seven decisions of three, the last of two steps
    options = ["transforms=[action_repeat]", "transforms.action_repeat.k=3", "algo=ppo"]
    options += ["frames_per_batch=84", "staggered_starts=false", "frames=160"]
    make_trainer(tmp_path, *options).run()
    table = read_table(tmp_path / "progress.csv")
    assert table["steps"] == [80, 160]
    assert table["episode_length"] == [20.0, 20.0]


def test_batches_that_cannot_be_shared_out_among_repeats_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"4 environments that take 4 steps at a time.*144 or 160"):
        make_trainer(tmp_path, "transforms=[action_repeat]", "frames_per_batch=150")


def test_where_worlds_cannot_be_stored_schedules_go_on_in_other_episodes(tmp_path, monkeypatch):
    monkeypatch.setattr(f"{__name__}.PointMass", Forgetful)
    options = ["algo=ppo", "transforms=[simmer]", "transforms.simmer.steps=80"]
    begun = make_trainer(tmp_path, *options, "transforms.simmer.first=0.25", "frames=160")
    seen = next(iter(begun.collector))["observation"]
    begun.run()
    resumed = make_trainer(tmp_path, *options, "transforms.simmer.first=0.25", "frames=320")
    assert resumed.resume()
    start = next(iter(resumed.collector))["observation"][:, :1]
    # after 40 of 80 steps
    assert seen[:, 0, -1].tolist() == [0.25] * 4
    assert start[:, 0, -1].tolist() == [0.625] * 4
    assert (seen[..., :2] != start[..., :2]).any(-1).all()


def test_what_transforms_of_torchrl_remember_goes_on_from_batch_to_batch(tmp_path):
    config = point_mass_config("algo=ppo", "frames_per_batch=40", "staggered_starts=null")
    changes = {"count": StepCounter(max_steps=15)}
    env = transform_env(PointMass(config.num_envs), changes, evaluating=False)
    trainer = trainer_of(config, tmp_path, env)
    batches = iter(trainer.collector)
    rows = [trainer.epoch(batches) for _ in range(4)]
    assert [row["episodes"] for row in rows] == [0, 4, 4, 0]
    assert rows[1]["episode_length"] == rows[2]["episode_length"] == 15


RUN = [
    *("env=PointGoal1", "env.num_steps=20", "num_envs=4", "frames_per_batch=80", "frames=240"),
    *("model.hidden_sizes=[8]", "logger=none", "num_threads=1", "certificate.episodes=0"),
    "hydra.run.dir=run",
]


@pytest.fixture
def command(tmp_path, monkeypatch, capsys):
    """Runs train.py in a folder of its own; returns its status and what it printed."""
    monkeypatch.chdir(tmp_path)
    source = """def slow(step, positions, layout, speed=0.3):
    assert positions["hazards"].shape[1:] == (8, 3) and "gyro" in layout
    return step["action"].clamp(-speed, speed)
"""
    Path("test_transforms_filters.py").write_text(source)
    monkeypatch.setitem(sys.modules, "test_transforms_filters", None)
    monkeypatch.delitem(sys.modules, "test_transforms_filters")
    monkeypatch.syspath_prepend(str(tmp_path))

    return lambda *arguments: (status_of(*arguments), *capsys.readouterr())


def test_the_command_line_runs_a_filter_of_the_users(command):
    own = "import=test_transforms_filters.py"
    words = ["algo=ppo_lagrangian", "transforms=[action_filter]", own]
    words += ["transforms.action_filter.filter._target_=test_transforms_filters.slow"]
    status, _, said = command(*RUN, *words, "cost_limits={cost_interventions: 3}")
    assert not status, said
    table = read_table(Path("run/progress.csv"))
    assert table["steps"] == [80, 160, 240]
    assert not evaluate_main(["run", "episodes=4", "num_envs=2", own])
    assert table["episode_cost_interventions"][-1] > 0
    assert any("cost_interventions" in n and not n.startswith(("episode", "cost")) for n in table)
    assert not command("resume=run", "frames=320", own)[0]
    assert read_table(Path("run/progress.csv"))["steps"][-1] == 320


def test_an_evaluation_returns_the_reward_of_the_environment(command):
    # hazards everywhere: no budget lasts
    unsafe = ["transforms.saute.unsafe_reward=-1000", "transforms.saute.budgets={cost: 0.001}"]
    unsafe += ["env.hazards_size=2.0", "env.hazards_keepout=0.0"]
    status, _, said = command(*RUN, "algo=ppo", "transforms=[saute]", *unsafe)
    assert not status, said
    result = evaluate(Path("run"), EvaluationOptions(episodes=4, num_envs=2, num_threads=1))
    assert result.estimates["episode_cost"].value > 0
    assert abs(read_table(Path("run/progress.csv"))["episode_return"][-1]) < 100
    assert abs(result.estimates["episode_return"].value) < 100
