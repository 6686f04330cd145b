"""What the shorthands of train.py are written out to, and what is refused."""

import re

import pytest
from hydra import compose, initialize_config_dir
from run_configs import point_mass_config

from safe_rl.cli.overrides import CommandLineError
from safe_rl.cli.shorthands import expand_arguments
from safe_rl.runs.record import RunRecord
from safe_rl.scores.slates import SLATES


@pytest.fixture
def run(tmp_path):
    """Folder of a run whose name Hydra's grammar would trip over."""
    directory = tmp_path / "it's frames=10,num_envs=4"
    with RunRecord(directory, point_mass_config(), {"cost": 25.0}, 20).writing():
        pass
    return directory


def test_arguments_without_shorthands_stay():
    arguments = ["env=PointGoal1", "+seed=0", "hydra.run.dir=resume"]
    assert expand_arguments(arguments) == arguments


def test_sweeps_run_on_joblib_where_it_is_installed(monkeypatch):
    arguments = ["-m", "env=PointGoal1,CarGoal1"]
    for is_there, launcher in ((True, ["hydra/launcher=joblib"]), (False, [])):
        monkeypatch.setattr("safe_rl.cli.shorthands._is_installed", lambda _, known=is_there: known)
        assert expand_arguments(arguments) == [*arguments, *launcher]
        told = [*arguments, "hydra/launcher=ray"]
        assert expand_arguments(told) == told


def test_resuming_reads_the_configuration_of_the_run(run):
    expanded = expand_arguments([f"resume={run}", "frames=99", "policy_update.max_kl=0.5"])
    assert expanded[:4] == ["--config-path", str(run), "--config-name", "config"]
    with initialize_config_dir(str(run), version_base="1.3"):
        config = compose("config", overrides=expanded[4:], return_hydra_config=True)
    assert config.hydra.run.dir == str(run)
    assert config.hydra.output_subdir is None
    assert config.frames == 99
    assert config.policy_update.max_kl == 0.5
    assert config.algo == point_mass_config().algo


@pytest.mark.parametrize(
    "override",
    ["algo=ppo", "env=CarGoal1", "seed=3", "preset=paper", "num_envs=8", "model.hidden_sizes=[8]"],
)
def test_what_cannot_change_in_a_continued_run(run, override):
    with pytest.raises(
        CommandLineError, match=rf"'{re.escape(override)}' cannot change.*init_from="
    ):
        expand_arguments([override, f"resume={run}"])


def test_a_number_that_cannot_change_is_not_told_that_numbers_can(run):
    with pytest.raises(CommandLineError, match="a checkpoint brings along, such as an optimiser's"):
        expand_arguments([f"resume={run}", "policy_update.optimizer.lr=1e-4"])


def test_only_a_run_can_be_resumed(run):
    with pytest.raises(CommandLineError, match=r"no config.yaml. Runs below it: .*it's frames"):
        expand_arguments([f"resume={run.parent}"])
    with pytest.raises(CommandLineError, match="start it again as it was"):
        expand_arguments(["-m", f"resume={run}"])
    with pytest.raises(CommandLineError, match="more than once"):
        expand_arguments([f"resume={run}", f"resume={run}"])


@pytest.mark.parametrize("shorthand", ["slate=SG6", "+slate=SG6"])
def test_a_slate_is_its_environments(shorthand):
    expanded = expand_arguments(["algo=ppo,cpo", shorthand, "-m", "hydra/launcher=basic"])
    assert expanded[:3] == ["-m", f"env={','.join(SLATES['SG6'])}", "algo=ppo,cpo"]


def test_flags_may_stand_anywhere_and_keep_their_values(run, tmp_path):
    given = ["seed=0,1", "-m", "slate=SG6", "--config-dir", "mine", "hydra/launcher=basic"]
    assert expand_arguments(given)[:2] == ["-m", "--config-dir=mine"]
    resumed = expand_arguments([f"resume={run}", "--config-dir", str(tmp_path), "frames=9"])
    assert resumed[-1] == "frames=9"
    assert f"--config-dir={tmp_path}" in resumed


def test_slates_that_cannot_be_written_out():
    with pytest.raises(CommandLineError, match="Did you mean 'SGPoint'"):
        expand_arguments(["-m", "slate=Point"])
    with pytest.raises(CommandLineError, match="6 environments: add -m"):
        expand_arguments(["slate=SG6"])
    with pytest.raises(CommandLineError, match="use one of them"):
        expand_arguments(["-m", "slate=SG6", "env=PointGoal1"])


def test_a_broken_configuration_is_named(run):
    (run / "config.yaml").write_text("algo: [")
    with pytest.raises(CommandLineError, match=r"config\.yaml cannot be read"):
        expand_arguments([f"resume={run}"])


@pytest.mark.parametrize("folder", ["hydra", "frames"])
def test_files_that_hydra_would_read_beside_the_configuration_are_refused(run, folder):
    (run / folder / "launcher").mkdir(parents=True)
    with pytest.raises(CommandLineError, match=f"/{folder} is a folder that runs never write"):
        expand_arguments([f"resume={run}", "--info", "++frames=500"])


@pytest.mark.parametrize(
    "override",
    [
        "env.hazards_num=3",
        "+env.hazards_num=3",
        "cost_limits.cost=3",
        "cost_limits={cost: 3}",
        "init_from=elsewhere",
        "policy_update.optimizer.lr=1",
        "policy_update._target_=os.system",
        "lagrangian.init=3",
        "logger=none",
        "collector=process",
        "hydra.run.dir=elsewhere",
        "hydra.sweep.dir=elsewhere",
        "--config-name",
        "-cp",
        "+mine=3",
        "~model",
    ],
)
def test_what_is_not_marked_as_changing_stays(run, override):
    with pytest.raises(CommandLineError, match=rf"'{re.escape(override)}' cannot change"):
        expand_arguments([f"resume={run}", override])


@pytest.mark.parametrize(
    "override",
    [
        *("frames=9", "device=cuda", "num_threads=3", "checkpoint.interval=3", "compile=true"),
        *("logger.exp_name=mine", "loss.entropy_coeff=0.1", "lagrangian.kp=0.5"),
        *("critic_update.num_passes=3", "hydra.verbose=true", "--cfg"),
    ],
)
def test_what_is_marked_may_change(run, override):
    assert expand_arguments([f"resume={run}", override])[-1] == override


def test_what_ray_is_started_with_is_not_taken_from_a_file(run):
    path = run / "config.yaml"
    local = path.read_text().replace("collector:\n", "collector:\n  ray_init: {address: null}\n")
    path.write_text(local)
    assert expand_arguments([f"resume={run}"])
    path.write_text(local.replace("null}", "far}"))
    with pytest.raises(CommandLineError, match=r"say again collector\.ray_init\.address="):
        expand_arguments([f"resume={run}"])
    assert expand_arguments([f"resume={run}", "collector.ray_init.address=far"])
    actors = "null}\n  resources: {runtime_env: {pip: [theirs]}}"
    for started in ("null, runtime_env: {pip: [theirs]}}", actors):
        path.write_text(local.replace("null}", started))
        with pytest.raises(CommandLineError, match="starts Ray with runtime_env"):
            expand_arguments([f"resume={run}"])


def test_several_folders_of_configurations_are_not_taken_for_the_last():
    both = ["--config-dir", "first", "algo=mine", "--config-dir=second", "env=mine"]
    with pytest.raises(
        CommandLineError, match=r"once: first, second\..*searchpath=\[file:///.*second\]"
    ):
        expand_arguments(both)
    assert expand_arguments(both[:3]) == ["--config-dir=first", "algo=mine"]


@pytest.mark.parametrize(
    ("override", "meant"), [("framse=9", "frames"), ("total_timesteps=9", "frames"), ("zzz=1", "")]
)
def test_what_a_run_does_not_have_is_no_setting_that_stays(run, override, meant):
    key, hint = override.partition("=")[0], f" Did you mean '{meant}'?" if meant else ""
    with pytest.raises(CommandLineError) as caught:
        expand_arguments([f"resume={run}", override])
    assert str(caught.value) == f"'{override}': the run has no '{key}'.{hint}"
