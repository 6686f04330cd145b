"""resume=RUN: what may change in a run that is continued, and what its files cannot do."""

import shutil

import pytest
from commands import composed
from omegaconf import OmegaConf
from run_configs import point_mass_config

from safe_rl.cli.composing import overrides_of, read_resumed, refuse_changes
from safe_rl.cli.config import check_settings
from safe_rl.runs.run import Run
from safe_rl.runs.writing import RunWriter

NAMES = ("it's frames=10,num_envs=4 a${oc.env:HOME}", "a\\'b ends with \\")


def begin(directory):
    config = point_mass_config("env.robot_base=point")
    check_settings(config)  # as a run does, which leaves out what it does not have
    with RunWriter(Run(directory), config, {"cost": 25.0}, 20).writing():
        pass
    return directory


@pytest.fixture(scope="module")
def begun(tmp_path_factory):
    return begin(tmp_path_factory.mktemp("begun") / "run")


@pytest.fixture
def run(begun, tmp_path):
    return shutil.copytree(begun, tmp_path / "run")


def resumed(directory, *words):
    (config,) = composed(f"resume={directory}", *words)
    refuse_changes(directory, config)
    return config


@pytest.mark.parametrize("name", NAMES)
def test_folders_may_have_any_name(begun, tmp_path, name):
    directory = shutil.copytree(begun, tmp_path / name)
    config = resumed(directory, "frames=3e5", "policy_update.max_kl=0.5")
    assert (config.frames, config.policy_update.max_kl) == (300_000, 0.5)
    assert config.hydra.run.dir == str(directory)
    assert config.algo == point_mass_config().algo


def test_the_updates_are_compiled_if_the_run_is(run):
    config = resumed(run, "compile=true")
    assert (config.policy_update.compile, config.critic_update.compile) == (True, True)
    config = resumed(run, "compile=true", "critic_update.compile=false")
    assert (config.policy_update.compile, config.critic_update.compile) == (True, False)


@pytest.mark.parametrize(
    "override",
    [
        *("env.hazards_num=3", "env=CarGoal1", "seed=3", "hydra.run.dir=elsewhere", "+mine=3"),
        *("policy_update.optimizer.lr=1e-5", "lagrangian.init=3"),
        *("policy_update._target_=os.system", "collector=process", "hydra.nope=3"),
    ],
)
def test_what_is_not_marked_as_changing_stays(run, override):
    with pytest.raises(
        ValueError, match=r"cannot change|no key|in its folder|keeps its (env|collector)|reach only"
    ):
        resumed(run, override)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        *(("frames", 9), ("checkpoint.interval", 3), ("compile", True), ("lagrangian.kp", 0.5)),
        ("model.hidden_sizes", [16]),  # as it was
    ],
)
def test_what_is_marked_may_change(run, key, value):
    config = resumed(run, f"{key}={value}".lower(), "hydra.verbose=true")
    assert OmegaConf.select(config, key) == value


def test_another_logger_leaves_no_keys_of_the_first(run):
    assert resumed(run, "logger=none").logger == {"_target_": None}
    config = OmegaConf.load(run / "config.yaml")
    config.logger = {"_target_": "safe_rl.runs.loggers.WandbLogger", "project": "mine"}
    OmegaConf.save(config, run / "config.yaml")
    for word in ("logger=none", *overrides_of({"logger": "none"})):  # on a command line, in Python
        assert "project" not in read_resumed(run, None, [word]).get("logger", {})


def test_only_a_run_can_be_resumed(run):
    with pytest.raises(ValueError, match=r"no config.yaml. Runs below it: .*/run"):
        composed(f"resume={run.parent}")
    with pytest.raises(ValueError, match="start it again as it was"):
        composed("-m", f"resume={run}")
    with pytest.raises(ValueError, match=r"no key 'framse'\. Did you mean 'frames'"):
        composed(f"resume={run}", "framse=9")
    (run / "progress.csv").rename(run / "checkpoints")  # those of an exported policy
    with pytest.raises(ValueError, match="an exported policy cannot be trained on"):
        composed(f"resume={run}")
    (run / "config.yaml").write_text("algo: [")
    with pytest.raises(ValueError, match=r"config\.yaml cannot be read"):
        composed(f"resume={run}")


def test_a_part_that_is_a_word_is_refused(run):
    config = OmegaConf.load(run / "config.yaml")
    config.policy_update = "trpo"
    OmegaConf.save(config, run / "config.yaml")
    with pytest.raises(ValueError, match=r"policy_update"):
        resumed(run)


def test_modules_that_the_command_imports_are_noted(run, tmp_path):
    (tmp_path / "module_to_resume.py").write_text("")
    module = str(tmp_path / "module_to_resume.py")
    config = resumed(run, f"import={module}", "frames=9")
    assert (config.frames, config["import"]) == (9, [module])


def test_what_ray_is_started_with_is_not_taken_from_a_file(run):
    path = run / "config.yaml"
    config = OmegaConf.load(path)
    for start in ({"ray_init": {"address": "far"}}, {"resources": {"runtime_env": {"pip": ["x"]}}}):
        config.collector = {"_target_": "safe_rl.collectors.make_ray_collector", **start}
        OmegaConf.save(config, path)
        with pytest.raises(ValueError, match=r"collector\.\w+\.\w+.*could run code"):
            read_resumed(run, None, [])


@pytest.mark.parametrize(
    "text",
    [
        'hydra: {callbacks: {x: {_target_: builtins.exec, _args_: [\'open("trace", "w")\']}}}',
        "hydra: {searchpath: [pkg://users_own]}",
        "defaults: [override hydra/launcher: joblib]",
        "# @package hydra.callbacks.x",
    ],
)
def test_what_hydra_would_run_is_not_read(run, text, monkeypatch):
    monkeypatch.chdir(run.parent)
    path = run / "config.yaml"
    path.write_text(f"{text}\n{path.read_text()}")
    try:
        config = composed(f"resume={run}", "frames=9")[0]
    except ValueError as error:
        assert text.partition(":")[0] in str(error)  # noqa: PT017
    else:
        assert config.frames == 9
        assert "x" not in (config.hydra.callbacks or {})
    assert not (run.parent / "trace").exists()
