"""What an evaluation refuses: wrong options, other observations, broken checkpoints."""

import shutil

import pytest
from evaluated_runs import skip_without_opengl
from omegaconf import OmegaConf

from safe_rl.cli.evaluate import main
from safe_rl.cli.report import main as report_main
from safe_rl.envs import ContractError
from safe_rl.evaluation.loading import override_env


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["env.hazard_num=3"], "hazards_num"),
        (["checkpoint=there.torchrl"], "checkpoint is last, best, certified or the path"),
        (["env.lidar_num_bins=8", "record=true"], "trained on other observations"),
        (["camera=nowhere", "video=true"], "nowhere"),
        (["picture=there.png"], "ending in .gif or .webp"),
    ],
)
def test_what_cannot_be_done_ends_in_one_line(run, arguments, message, capsys, monkeypatch):
    if "video=true" in arguments:
        skip_without_opengl()
        # before any episode
        monkeypatch.setattr("safe_rl.evaluation.measuring.collect_episodes", None)
    (run / "evaluation.transitions").mkdir()
    (run / "evaluation.transitions" / "00000000.pt").touch()
    assert main([str(run), *arguments]) == 1
    error = capsys.readouterr().err.splitlines()[-1]
    assert error.startswith("error: ")
    assert message in error
    assert (run / "evaluation.transitions" / "00000000.pt").exists()


def test_nothing_is_recorded_through_a_link(run, tmp_path, capsys):
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "00000003.pt").touch()
    (run / "evaluation.transitions").symlink_to(mine)
    assert main([str(run), "record=true", "episodes=1"]) == 1
    assert "evaluation.transitions is a link" in capsys.readouterr().err
    assert (mine / "00000003.pt").exists()


@pytest.mark.parametrize(
    ("arguments", "place"), [([], "evaluation.json"), (["picture=there.gif"], "../there.gif")]
)
def test_what_cannot_be_written_is_said_before_any_episode(
    arguments, place, run, capsys, monkeypatch
):
    monkeypatch.chdir(run.parent)
    monkeypatch.setattr("safe_rl.evaluation.measuring.collect_episodes", None)
    (run / place).mkdir()
    assert main([str(run), *arguments]) == 1
    error = capsys.readouterr().err.splitlines()[-1]
    assert error.startswith("error: ")
    assert f"{place.removeprefix('../')} is a folder, where a file is to be written." in error


def test_a_run_that_others_may_only_read_is_evaluated_as_a_copy(run, capsys, monkeypatch):
    monkeypatch.setattr("os.access", lambda path, mode: False)  # root may write anywhere
    assert main([str(run)]) == 1
    error = capsys.readouterr().err.splitlines()[-1]
    assert f"{run} is read-only. A run's evaluations lie in its folder: evaluate a copy" in error


@pytest.mark.parametrize(("command", "what"), [(main, "RUN_DIR"), (report_main, "RUNS_DIR")])
def test_a_command_without_a_folder_asks_for_it(command, what, capsys):
    assert command(["import=json"]) == 2
    assert f" {what} [option=value ...]" in capsys.readouterr().out


def test_an_environment_that_breaks_its_contract_ends_in_one_line(run, capsys, monkeypatch):
    """A family of one's own that makes 20 environments, say, however many it is asked for."""

    def make(*node, **options):
        raise ContractError("mine was asked for 25 environments and made 20")

    monkeypatch.setattr("safe_rl.evaluation.loading.make_env", make)
    assert main([str(run)]) == 1
    assert "error: mine was asked for 25" in capsys.readouterr().err


def test_without_a_best_checkpoint_the_last_is_offered(run, capsys):
    shutil.rmtree(run / "checkpoints" / "best")
    assert main([str(run), "checkpoint=best"]) == 1
    error = capsys.readouterr().err
    assert "in no epoch did episodes end that kept every cost limit, with estimate_<cost>" in error
    assert "≤ target_<cost>. Use checkpoint=last" in error


def test_the_policy_of_another_run_is_not_evaluated_as_the_runs_own(run, capsys):
    """Its figures would lie in the run's folder, and stand in its row of a report."""
    other = run.parent / "other"
    shutil.copytree(run, other)
    theirs = max((other / "checkpoints" / "last").iterdir())
    assert main([str(run), "episodes=1", f"checkpoint={theirs}"]) == 0  # of a copy
    config = OmegaConf.load(other / "config.yaml")
    config.seed += 1
    OmegaConf.save(config, other / "config.yaml")
    assert main([str(run), "episodes=1", f"checkpoint={theirs}"]) == 1
    assert f"is a checkpoint of another run, {other}: name that run." in capsys.readouterr().err


def test_of_mappings_only_what_is_named_changes():
    """The others would go back to the environment's own, without a word."""
    cost = {"_target_": "mine.cost", "limit": 1.0}
    kwargs = {"gravity": 1, "size": {"width": 2, "height": 3}}
    config = OmegaConf.create({"env": {"name": "mine", "kwargs": kwargs, "cost": cost}})
    env = override_env(config, {"kwargs": {"gravity": 5, "size": {"width": 7}}})
    assert env["kwargs"] == {"gravity": 5, "size": {"width": 7, "height": 3}}
    assert override_env(config, {"cost": {"limit": 2.0}})["cost"] == {**cost, "limit": 2.0}


def test_keys_that_an_environment_of_ones_own_does_not_have_are_refused(run, capsys):
    """It would leave them alone, and what was not changed would be measured as if it were."""
    config = OmegaConf.load(run / "config.yaml")
    config.env = {"_target_": "users.make", "name": "mine", "edge": 1.0}
    OmegaConf.save(config, run / "config.yaml")
    assert main([str(run), "env.edgy=0.5"]) == 1
    error = capsys.readouterr().err
    assert "users.make has no such key. Did you mean 'edge'? The run has edge." in error
    assert override_env(config, {"edge": 0.5})["edge"] == 0.5
