"""The configuration of a run that is continued: what may change, what may be said again."""

import pytest
from omegaconf import OmegaConf
from run_configs import point_mass_config

from safe_rl.cli.composing import compose_resumed
from safe_rl.cli.grammar import CommandLineError
from safe_rl.cli.train import read_command
from safe_rl.runs.run import Run
from safe_rl.runs.writing import RunWriter

SAID = ["env=PointMass", "logger=none", "transforms=[]", "lagrangian=default"]
NAMES = ("it's frames=10,num_envs=4", "a${oc.env:HOME}", "a\\'b", "ends with \\")


def begin(directory):
    config = point_mass_config("env.robot_base=point")
    with RunWriter(Run(directory), config, {"cost": 25.0}, 20).writing():
        pass
    Run(directory).notes_folder.mkdir()
    Run(directory).overrides_file.write_text(OmegaConf.to_yaml(OmegaConf.create(SAID)))
    return directory


@pytest.fixture
def run(tmp_path):
    return begin(tmp_path / "run")


@pytest.mark.parametrize("name", NAMES)
def test_folders_may_have_any_name(tmp_path, name):
    directory = begin(tmp_path / name)
    command = read_command([f"resume={directory}", "frames=3e5", "policy_update.max_kl=0.5"])
    assert command.run == directory
    (config,) = command.configs
    assert (config.frames, config.policy_update.max_kl) == (300_000, 0.5)
    assert config.algo == point_mass_config().algo


@pytest.mark.parametrize(
    "override",
    [
        *("env.hazards_num=3", "env=CarGoal1", "seed=3", "preset=paper", "num_envs=8"),
        *("model.hidden_sizes=[8]", "+env.hazards_num=3", "cost_limits={cost: 3}"),
        *("init_from=elsewhere", "policy_update.optimizer.lr=1e-5", "lagrangian.init=3"),
        *("policy_update._target_=os.system", "logger=mlflow", "collector=process"),
        *("hydra.run.dir=elsewhere", "hydra.sweep.dir=elsewhere", "+mine=3"),
        *("~model", "~loss.entropy_coeff"),
    ],
)
def test_what_is_not_marked_as_changing_stays(run, override):
    with pytest.raises(CommandLineError) as caught:
        compose_resumed(run, [override])
    words = str(caught.value)
    assert words.startswith(f"'{override}' cannot change") or override.startswith("env.hazards")
    assert f"init_from={run}" in words or "there is no key" in words


@pytest.mark.parametrize(
    ("key", "value"),
    [
        *(("frames", 9), ("num_threads", 3), ("checkpoint.interval", 3), ("compile", True)),
        *(("loss.entropy_coeff", 0.1), ("lagrangian.kp", 0.5), ("critic_update.num_passes", 3)),
    ],
)
def test_what_is_marked_may_change(run, key, value):
    config = compose_resumed(run, [f"{key}={value}".lower(), "hydra.verbose=true"])
    assert OmegaConf.select(config, key) == value


@pytest.mark.parametrize(
    "override",
    [
        *("env.robot_base=point", "seed=0", "preset=default", "num_envs=4"),
        *("model.hidden_sizes=[16]", "policy_update.optimizer.lr=${.lr}", "frames=1280"),
        *SAID,
    ],
)
def test_values_of_a_run_may_be_said_again(run, override):
    override = override.replace("${.lr}", str(point_mass_config().policy_update.optimizer.lr))
    before = compose_resumed(run, [])
    assert compose_resumed(run, [override, f"hydra.run.dir={run}"]) == before


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("framse=9", r"there is no key 'framse'\. Did you mean 'frames'\?$"),
        ("frames=9,10", "a run has one value"),
        ("policy_update.optimizer.lr=1e-9", "not an optimiser's lr: the checkpoint has it"),
    ],
)
def test_refusals_name_what_to_write(run, override, words):
    with pytest.raises(CommandLineError, match=words):
        compose_resumed(run, [override])


def test_only_a_run_can_be_resumed(run):
    with pytest.raises(CommandLineError, match=r"no config.yaml. Runs below it: .*/run"):
        read_command([f"resume={run.parent}"])
    with pytest.raises(CommandLineError, match="start it again as it was"):
        read_command(["-m", f"resume={run}"])
    with pytest.raises(CommandLineError, match="no flag goes with it"):
        read_command([f"resume={run}", "--cfg=job"])
    (run / "config.yaml").write_text("algo: [")
    with pytest.raises(CommandLineError, match=r"config\.yaml cannot be read"):
        compose_resumed(run, [])
    (run / "progress.csv").rename(run / "checkpoints")  # those of an exported policy
    with pytest.raises(CommandLineError, match="an exported policy cannot be trained on"):
        compose_resumed(run, [])


def test_folders_of_configurations_and_modules_may_stay_in_the_command(run, tmp_path, monkeypatch):
    (tmp_path / "module_to_resume.py").write_text("")
    module = str(tmp_path / "module_to_resume.py")
    words = ["--config-dir", str(tmp_path), f"import={module}", f"resume={run}", "frames=9"]
    (config,) = read_command(words).configs
    assert (config.frames, config["import"]) == (9, [module])


def test_what_ray_is_started_with_is_not_taken_from_a_file(run):
    path = run / "config.yaml"
    local = path.read_text().replace("collector:\n", "collector:\n  ray_init: {address: null}\n")
    on_ray = "_target_: safe_rl.collectors.make_ray_collector\n  num_collectors"
    local = local.replace("_target_: null\n  num_collectors", on_ray)
    path.write_text(local.replace("null}", "far}"))
    with pytest.raises(CommandLineError, match=r"again, collector\.ray_init\.address="):
        compose_resumed(run, [])
    actors = "null}\n  resources: {runtime_env: {pip: [theirs]}}"
    for started in ("null, runtime_env: {pip: [theirs]}}", actors):
        path.write_text(local.replace("null}", started))
        with pytest.raises(CommandLineError, match=r"collector\.\w+\.runtime_env.*could run code"):
            compose_resumed(run, [])


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
    (run / "hydra" / "launcher").mkdir(parents=True)
    path = run / "config.yaml"
    path.write_text(f"{text}\n{path.read_text()}")
    config = compose_resumed(run, ["frames=9"])
    assert config.frames == 9
    assert not (run.parent / "trace").exists()
