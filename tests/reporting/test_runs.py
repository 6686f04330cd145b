"""Which folders count as runs, how they are grouped, and what they are called."""

import json

import pytest
import yaml
from synthetic import grouped, write_run

from safe_rl.files import CONF
from safe_rl.reporting.archive import read_runs
from safe_rl.reporting.experiments import distinguishing_keys, title_of


def names(experiments):
    return [(e.environment, e.algorithm, [run.seed for run in e.runs]) for e in experiments]


def note_sources(directory, *sources, **others):
    """Folders of configurations, as Hydra notes them."""
    record = {"hydra": {"runtime": {"config_sources": sources}, **others}}
    (directory / ".hydra/hydra.yaml").write_text(json.dumps(record))


@pytest.mark.parametrize("name", sorted(path.stem for path in (CONF / "algo").glob("*.yaml")))
def test_every_algorithm_has_the_name_that_the_field_gives_it(name):
    title = title_of(name)
    assert title.lower().replace("-", "_") == name
    assert title != name


def test_seeds_of_one_configuration_are_one_experiment(tmp_path):
    for seed in (20, 0, 10):
        write_run(tmp_path, "PointGoal1", "cpo", seed, device="cpu", num_threads=seed + 1)
    write_run(tmp_path, "PointGoal1", "ppo", 0)
    write_run(tmp_path, "CarPush1", "ppo", 0)
    experiments, skipped = grouped(tmp_path)
    # in the order of the benchmark and of the paper's tables
    assert names(experiments) == [
        ("PointGoal1", "PPO", [0]),
        ("PointGoal1", "CPO", [0, 10, 20]),
        ("CarPush1", "PPO", [0]),
    ]
    assert not skipped
    assert [e.benchmark for e in experiments] == ["PointGoal1", "PointGoal1", "CarPush1"]


def test_a_run_knows_its_command_and_its_end(tmp_path):
    said = ["env=PointGoal1", "cost_limits={cost: 10}", "seed=0"]
    write_run(tmp_path, epochs=2, overrides=said)
    write_run(tmp_path, seed=1, frames=9000)
    (tmp_path / "PointGoal1/ppo/seed1/.hydra/overrides.yaml").unlink()
    write_run(tmp_path, seed=2, overrides=[])
    first, second, third = read_runs(tmp_path)[0]
    assert first.repeating == "python train.py env=PointGoal1 'cost_limits={cost: 10}' seed=0"
    assert (first.steps, first.is_finished, first.hours) == (2000, True, 0.002)
    assert (second.repeating, third.repeating) == (None, "python train.py")
    assert not second.is_finished
    assert read_runs(tmp_path, unfinished=True)[0][1].is_finished


def test_a_command_has_what_the_overrides_do_not_say(tmp_path):
    run = write_run(tmp_path, overrides=["env=PointGoal1", "frames=500", "seed=0"])
    sources = [
        {"path": "/home/me/conf", "provider": "main"},
        {"path": "/home/me/my conf", "provider": "command-line"},
    ]
    note_sources(run, *sources, run={"dir": "${oc.env:HOME}"})
    (run / ".hydra/config.yaml").write_text("{frames: 500, device: cuda, model: {sizes: [8]}}")
    # it was continued to 1000, and with other sizes
    config = yaml.safe_load((run / "config.yaml").read_text()) | {"model": {"sizes": [16]}}
    (run / "config.yaml").write_text(yaml.safe_dump(config))
    (found,), _ = read_runs(tmp_path)
    assert found.repeating == (
        "python train.py '--config-dir=/home/me/my conf' env=PointGoal1 seed=0 frames=1000 "
        "'model.sizes=[16]'"
    )
    (run / ".hydra/config.yaml").write_text("frames: ${paper.frames.point}")
    (run / ".hydra/hydra.yaml").unlink()
    assert read_runs(tmp_path)[0][0].repeating == "python train.py env=PointGoal1 frames=500 seed=0"


@pytest.mark.parametrize("kind", ["of a file", "continued"])
def test_names_have_what_a_file_of_the_users_or_resuming_has_changed(tmp_path, kind):
    """As in `+experiment=mine loss.clip=0.1`, whose command line has one of two differences."""
    plain = {"loss": {"clip": 0.2}, "policy_update": {"max_kl": 0.01}}
    changed = {"loss": {"clip": 0.1}, "policy_update": {"max_kl": 0.05}}
    write_run(tmp_path, algo="mine", folder="plain", **plain)
    run = write_run(tmp_path, algo="mine", folder=kind, overrides=["loss.clip=0.1"], **changed)
    assert [name for _, name, _ in names(grouped(tmp_path)[0])] == ["mine", "mine (loss.clip=0.1)"]
    if kind == "of a file":
        note_sources(run, {"path": "/home/me/conf", "provider": "command-line"})
    else:
        (run / ".hydra/config.yaml").write_text(json.dumps(plain | {"loss": changed["loss"]}))
    _, (_, name, _) = names(grouped(tmp_path)[0])
    assert name == "mine (loss.clip=0.1, policy_update.max_kl=0.05)"


def test_what_is_no_run_is_named_with_its_reason(tmp_path):
    good = write_run(tmp_path)
    (tmp_path / "again").symlink_to(good)
    (good / "wandb").mkdir()
    (good / "wandb" / "latest-run").symlink_to(good)
    wandb = good / "wandb" / "offline-run-20260131_120000-ab12" / "files"
    wandb.mkdir(parents=True)
    (wandb / "config.yaml").write_text("wandb_version: 1\n")  # is not even named
    foreign, unbegun, empty, torn, garbled = (
        write_run(tmp_path, seed=seed, folder=f"f{seed}") for seed in range(1, 6)
    )
    (foreign / "config.yaml").write_text("some: thing")
    (unbegun / "progress.csv").unlink()
    (empty / "progress.csv").write_text("epoch,steps\n")
    (torn / "progress.csv").write_text("epoch,steps\n1,1000\n2\n")
    (garbled / "config.yaml").write_text("{")
    runs, skipped = read_runs(tmp_path)
    assert [run.directory for run in runs] == [good]
    reasons = {path.name: reason for path, reason in skipped.items()}
    assert len(reasons) == 6
    assert reasons["again"] == "it is a link to a folder, which is not followed"
    assert reasons["f1"].endswith("it lacks a usable env, algo, seed, frames")
    assert reasons["f2"] == "no progress.csv: it is no run of safe_rl, or has not begun"
    assert reasons["f3"] == "it has not finished an epoch"
    assert "progress.csv, line 3 has 1 fields" in reasons["f4"]
    assert reasons["f5"].startswith("config.yaml cannot be read")


def test_without_any_run_there_is_an_error_with_the_reasons(tmp_path):
    with pytest.raises(FileNotFoundError, match="a run is a folder with config"):
        read_runs(tmp_path)
    (write_run(tmp_path) / "progress.csv").unlink()
    with pytest.raises(FileNotFoundError, match=r"seed0: no progress\.csv: it is no run"):
        read_runs(tmp_path)
    with pytest.raises(FileNotFoundError, match="There is no folder"):
        read_runs(tmp_path / "elsewhere")


def test_of_the_same_run_twice_the_one_that_came_further_is_kept(tmp_path):
    longer = write_run(tmp_path, epochs=2, folder="longer")
    shorter = write_run(tmp_path, frames=2000, folder="shorter")
    newer = write_run(tmp_path, seed=1, frames=2000, folder="2026-02-01_12-00-00_seed1")
    # written last, as files of a clone are in any order
    older = write_run(tmp_path, seed=1, frames=2000, folder="2026-01-31_12-00-00_seed1")
    (experiment,), skipped = grouped(tmp_path)
    assert [run.directory for run in experiment.runs] == [longer, newer]
    assert skipped == {
        shorter: f"{longer} is the same run with the same seed",
        older: f"{newer} is the same run with the same seed",
    }


def test_variants_are_told_apart_by_what_differs(tmp_path):
    write_run(tmp_path, algo="ppo_lagrangian", limits={"cost": 25.0}, folder="a")
    write_run(tmp_path, algo="ppo_lagrangian", limits={"cost": 10.0}, folder="b")
    write_run(tmp_path, algo="mine", model={"hidden_sizes": [64]}, folder="c")
    write_run(tmp_path, algo="mine", model={"hidden_sizes": [8, 8]}, folder="d")
    # what nobody has set is named where nothing else tells runs apart
    for number in range(2):
        loss = {"a": number, "b": number, "c": 1}
        write_run(tmp_path, algo="yours", folder=str(number), loss=loss)
    multiplier = {"_target_": "safe_rl.objectives.PIDMultiplier", "ki": 0.1}
    write_run(tmp_path, algo="cpo", lagrangian=multiplier, folder="e")
    write_run(tmp_path, algo="cpo", lagrangian={"_target_": "some.LagrangeMultiplier"}, folder="f")
    assert [name for _, name, _ in names(grouped(tmp_path)[0])] == [
        "PPO-Lagrangian (cost ≤ 10)",
        "PPO-Lagrangian (cost ≤ 25)",
        "CPO (lagrangian=LagrangeMultiplier)",
        "CPO (lagrangian=PIDMultiplier)",
        "mine (model.hidden_sizes=[64])",
        "mine (model.hidden_sizes=[8,8])",
        "yours (loss.a=0, loss.b=0)",
        "yours (loss.a=1, loss.b=1)",
    ]


def test_seeds_that_start_from_checkpoints_of_seeds_are_one_experiment(tmp_path):
    for seed in (0, 10):
        for kind, steps in (("best", 1000 + seed), ("last", 3000), ("last", 4000)):
            checkpoint = f"checkpoints/{kind}/checkpoint-{steps:012d}.torchrl"
            source = f"first/seed{seed}/{checkpoint}"
            folder = f"{kind}{steps}_{seed}"
            write_run(tmp_path, "PointGoal2", "cpo", seed, init_from=source, folder=folder)
    last = "init_from=first/*/checkpoints/last/checkpoint"
    assert names(grouped(tmp_path)[0]) == [
        ("PointGoal2", "CPO (init_from=first/*/checkpoints/best)", [0, 10]),
        ("PointGoal2", f"CPO ({last}-000000003000.torchrl)", [0, 10]),
        ("PointGoal2", f"CPO ({last}-000000004000.torchrl)", [0, 10]),
    ]


def test_names_leave_out_what_nobody_has_set(tmp_path):
    lagrangian = {"_target_": "a.PIDMultiplier", "ki": 0.1}
    write_run(tmp_path, "PointGoal1", num_envs=20, frames_per_batch=20, lagrangian=lagrangian)
    write_run(
        tmp_path, "CarGoal1", num_envs=4, frames_per_batch=40, limits={"cost_hazards": 10.0},
        lagrangian={"_target_": "a.LagrangeMultiplier", "lr": 1.0}, frames=1,
    )  # fmt: skip
    other = {"num_envs": 4, "frames_per_batch": 40, "lagrangian": {**lagrangian, "ki": 0.2}}
    write_run(tmp_path, "DoggoGoal1", **other, tail=0.1, init_from="runs/x/seed0")
    experiments, _ = grouped(tmp_path)
    # of the rest nobody has set anything, and each environment has one
    assert {e.environment: e.algorithm for e in experiments} == {
        "PointGoal1": "PPO (cost ≤ 25)",
        "CarGoal1": "PPO (cost_hazards ≤ 10)",
        "DoggoGoal1": "PPO (init_from=runs/x, cost ≤ 25)",
    }


def test_names_have_what_the_command_lines_of_their_runs_have_set(tmp_path):
    """Defaults that differ, as those of another version, are in no name."""
    said = ["algo=mine", "loss.a=2", "+memory=gru"]
    memory = {"memory": {"_target_": "x.GRU", "size": 3}}
    write_run(tmp_path, algo="mine", loss={"a": 1, "b": 1}, folder="plain")
    write_run(tmp_path, algo="mine", loss={"a": 2, "b": 2}, **memory, overrides=said, folder="set")
    write_run(tmp_path, "CarGoal1", algo="mine", loss={"a": 1, "b": 9})
    found = {(e.environment, e.algorithm) for e in grouped(tmp_path)[0]}
    assert found == {
        ("PointGoal1", "mine"), ("PointGoal1", "mine (loss.a=2, memory=GRU)"),
        ("CarGoal1", "mine"),
    }  # fmt: skip


def test_how_long_a_run_is_is_said_once(tmp_path):
    for env, frames in (("PointGoal1", 2000), ("DoggoGoal1", 1000)):
        run = write_run(tmp_path, env, "cpo", frames=frames)
        with (run / "config.yaml").open("a") as file:
            file.write(f"limits: {{frames: {frames}}}\n")
    assert {name for _, name, _ in names(grouped(tmp_path)[0])} == {"CPO"}


def test_the_preset_stands_for_what_follows_from_it():
    point = [
        {"preset": "default", "frames": 3, "model.width": 64},
        {"preset": "paper", "frames": 10, "model.width": 256},
    ]
    # what differs between environments alone tells nothing apart
    doggo = [{"preset": "paper", "frames": 100, "model.width": 256}]
    assert distinguishing_keys([point, doggo]) == ["preset"]
    assert distinguishing_keys([doggo, point[:1]]) == []
    point.append({"preset": "paper", "frames": 20, "model.width": 256})
    assert distinguishing_keys([point, doggo]) == ["preset", "frames"]


def test_a_changed_environment_is_another_one(tmp_path):
    write_run(tmp_path, folder="a")
    write_run(tmp_path, folder="b", env_changes={"hazards_num": 12, "layout_seeds": 5})
    write_run(tmp_path, folder="c", env="Mine", env_changes={"hazards_num": 1})
    write_run(tmp_path, folder="d", env="Mine", env_changes={"hazards_num": 2})
    experiments, _ = grouped(tmp_path)
    assert [(e.environment, e.benchmark) for e in experiments] == [
        ("PointGoal1", "PointGoal1"),
        ("Mine (hazards_num=1)", None),
        ("Mine (hazards_num=2)", None),
        ("PointGoal1 (layout_seeds=5, hazards_num=12)", None),
    ]
