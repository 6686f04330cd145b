"""What an evaluation refuses: wrong options, other observations, broken checkpoints."""

import shutil
from unittest.mock import Mock

import pytest
from evaluated_runs import skip_without_opengl
from omegaconf import OmegaConf

from safe_rl.cli.evaluate import main
from safe_rl.cli.report import main as report_main
from safe_rl.envs import ContractError
from safe_rl.evaluation.loading import override_env


@pytest.fixture
def refused(run, capsys):
    """Evaluates the run, which is refused; returns the line that says why."""

    def refused(*arguments):
        assert main([str(run), *arguments]) == 1
        error = capsys.readouterr().err.splitlines()[-1]
        assert error.startswith("error: ")
        return error

    return refused


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
def test_what_cannot_be_done_ends_in_one_line(run, refused, arguments, message, monkeypatch):
    if "video=true" in arguments:
        skip_without_opengl()
        # before any episode
        monkeypatch.setattr("safe_rl.evaluation.measuring.collect_episodes", None)
    (run / "evaluation.transitions").mkdir()
    (recorded := run / "evaluation.transitions" / "00000000.pt").touch()
    assert message in refused(*arguments)
    assert recorded.exists()


def test_nothing_is_recorded_through_a_link(run, refused, tmp_path):
    (mine := tmp_path / "mine").mkdir()
    (mine / "00000003.pt").touch()
    (run / "evaluation.transitions").symlink_to(mine)
    assert "evaluation.transitions is a link" in refused("record=true", "episodes=1")
    assert (mine / "00000003.pt").exists()


@pytest.mark.parametrize(
    ("arguments", "place"), [([], "evaluation.json"), (["picture=there.gif"], "../there.gif")]
)
def test_what_cannot_be_written_is_said_before_any_episode(
    arguments, place, run, refused, monkeypatch
):
    monkeypatch.chdir(run.parent)
    monkeypatch.setattr("safe_rl.evaluation.measuring.collect_episodes", None)
    (run / place).mkdir()
    words = f"{place.removeprefix('../')} is a folder, where a file is to be written."
    assert words in refused(*arguments)


def test_a_run_that_others_may_only_read_is_evaluated_as_a_copy(run, refused, monkeypatch):
    monkeypatch.setattr("os.access", lambda path, mode: False)  # root may write anywhere
    words = f"{run} is read-only. A run's evaluations lie in its folder: evaluate a copy"
    assert words in refused()


@pytest.mark.parametrize(("command", "what"), [(main, "RUN_DIR"), (report_main, "RUNS_DIR")])
def test_a_command_without_a_folder_asks_for_it(command, what, capsys):
    assert command(["import=json"]) == 2
    assert f" {what} [option=value ...]" in capsys.readouterr().out


def test_an_environment_that_breaks_its_contract_ends_in_one_line(refused, monkeypatch):
    """A family of one's own that makes 20 environments, say, however many it is asked for."""
    error = ContractError("mine was asked for 25 environments and made 20")
    monkeypatch.setattr("safe_rl.evaluation.loading.make_env", Mock(side_effect=error))
    assert refused().startswith("error: mine was asked for 25")


def test_without_a_best_checkpoint_the_last_is_offered(run, refused):
    shutil.rmtree(run / "checkpoints" / "best")
    error = refused("checkpoint=best")
    assert "in no epoch did episodes end that kept every cost limit, with estimate_<cost>" in error
    assert "≤ target_<cost>. Use checkpoint=last" in error


def test_the_policy_of_another_run_is_not_evaluated_as_the_runs_own(run, refused):
    """Its figures would lie in the run's folder, and stand in its row of a report."""
    other = shutil.copytree(run, run.parent / "other")
    theirs = max((other / "checkpoints" / "last").iterdir())
    assert main([str(run), "episodes=1", f"checkpoint={theirs}"]) == 0  # of a copy
    config = OmegaConf.load(other / "config.yaml")
    config.seed += 1
    OmegaConf.save(config, other / "config.yaml")
    error = refused("episodes=1", f"checkpoint={theirs}")
    assert f"is a checkpoint of another run, {other}: name that run." in error


def test_of_mappings_only_what_is_named_changes():
    """The others would go back to the environment's own, without a word."""
    cost = {"_target_": "mine.cost", "limit": 1.0}
    kwargs = {"gravity": 1, "size": {"width": 2, "height": 3}}
    config = OmegaConf.create({"env": {"name": "mine", "kwargs": kwargs, "cost": cost}})
    env = override_env(config, {"kwargs": {"gravity": 5, "size": {"width": 7}}})
    assert env["kwargs"] == {"gravity": 5, "size": {"width": 7, "height": 3}}
    assert override_env(config, {"cost": {"limit": 2.0}})["cost"] == {**cost, "limit": 2.0}


def test_keys_that_an_environment_of_ones_own_does_not_have_are_refused(run, refused):
    """It would leave them alone, and what was not changed would be measured as if it were."""
    config = OmegaConf.load(run / "config.yaml")
    config.env = {"_target_": "users.make", "name": "mine", "edge": 1.0}
    OmegaConf.save(config, run / "config.yaml")
    words = "users.make has no such key. Did you mean 'edge'? The run has edge."
    assert words in refused("env.edgy=0.5")
    assert override_env(config, {"edge": 0.5})["edge"] == 0.5
