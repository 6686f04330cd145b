"""Names on the command line: a wrong one is refused with what was meant, before a run."""

import pytest

from safe_rl.cli.grammar import CommandLineError
from safe_rl.cli.schema import SettingError
from safe_rl.cli.train import read_command
from safe_rl.envs import ConfigError

MINE = """
# @package _global_
mine: {tail: 0.25, weight: 1.0}
lagrangian:
  init: ${mine.tail}
"""
RIGHT = [
    ["-m", "env=PointGoal1,CarGoal2", "env.hazards_num=3,4", "seed=range(3)", "+note=a,b"],
    ["algo=trpo_lagrangian", "lagrangian=adam", "lagrangian.lr=0.1", "cost_limits={cost: 3}"],
    ["collector=process", "logger=none", "hydra.run.dir=x", "checkpoint.interval=5", "frames=3e5"],
    ["hydra/launcher=basic", "+policy_update.max_grad_norm=0.5", "model.input_scale={position: 2}"],
    ["algo=cpo", "preset=paper", "policy_update.target_kl=0.02", "++seed=3"],
    ["policy_update/ppo@policy_update=paper", "policy_update.optimizer.lr=3e-4"],
    ["algo=sac", "policy_update.optimizer.lr=1e-3", "loss.gamma=0.9"],
]
WRONG = {
    "env.hazard_num=3": r"there is no key 'env.hazard_num'\. Did you mean 'env.hazards_num'\?",
    "total_timesteps=3": "there is no key 'total_timesteps'. Did you mean 'frames'",
    "max_steps=3": r"there is no key 'max_steps'\. Did you mean 'frames'\?$",
    "task=PointGoal2": r"there is no key 'task'\. Did you mean 'env'\?$",
    "environment=PointGoal2": "there is no key 'environment'. Did you mean 'env'",
    "algo_name=cpo": "there is no key 'algo_name'. Did you mean 'algo'",
    "learning_rate=1e-4": "Did you mean 'policy_update.optimizer.lr' or 'critic_update.optim",
    "loss.clip_ratio=0.1": r"Did you mean 'loss\.clip_epsilon'\?$",
    "target_kl=0.1": "Did you mean 'policy_update.max_kl'",
    "discount=0.9": r"Did you mean 'cost_advantage\.gamma' or 'advantage\.gamma'\?$",
    "epochs=4": "Did you mean 'policy_update.num_passes'",
    "env.name=PointGoal2": "would train env=PointGoal1 under the name of .*write env=PointGoal2",
    "algo.name=cpo": "would train algo=ppo_lagrangian under the name of .*write algo=cpo",
    "preset.frames=3": "there is no key 'preset.frames'. Did you mean 'frames'",
    "frmaes=3": "there is no key 'frmaes'. Did you mean 'frames'",
    "+lr=1e-4": "Did you mean 'policy_update.optimizer.lr' or 'critic_update.optimizer.lr'",
    "policy_update.lr=1e-4": "Did you mean 'policy_update.optimizer.lr'",
    "max_grad_norm=1": r"Did you mean '\+policy_update.max_grad_norm'",
    "policy_update.max_kll=1": "Did you mean 'policy_update.max_kl'",
    "+policy_update.max_kll=1": "no key 'policy_update.max_kll'.*'policy_update.max_kl'",
    "+checkpoint.kept=1": "no key 'checkpoint.kept'.*'checkpoint.keep_last'",
    "+logger.path=x": "no key 'logger.path'",
    "~frames": "'frames' not found",
    "transforms.saute.budgets.cost=1": r"budgets are given all at once, as .*='\{cost: 1\}'",
    "model.input_scale.gyro=1": r"factors are given all at once, as .*='\{gyro: 1\}'",
    "certificate={episodez: 5}": r"mean 'certificate\.episodes'\?$",
    "dir=x": r"no key 'dir'\. Did you mean 'hydra\.run\.dir'\?$",
    "zzzzz=3": "'--cfg job' prints all keys",
    "+seed=1": "at 'seed'. Either remove [+] prefix: 'seed=1'",
    "env=PointGaol1": "no env 'PointGaol1'. Did you mean 'PointGoal1'",
    "preset=hard_tasks": "'preset=hard_tasks' is not for this algorithm: algo/ppo_lagrangian has",
    "policy_update=paper": r"write policy_update/ppo@policy_update=…$",
    "limits=bad": r"no limits 'bad'\. There are default, ",
    "env=zzzzz": r"no env 'zzzzz'\. 'python train.py --help' names all; a file of yours needs --c",
    "cost_limits.cost=10": r"cost_limits='\{cost: 10\}'",
    "frames=[1": r"frames=\[1",
    "seed=0,1": "--multirun",
    "frames=${nowhere}": "frames: .*nowhere",
    "transforms=[saut]": r"there is no transforms 'saut'\. Did you mean 'saute'\?$",
    "--algo=cpo": r"'--algo=cpo': there is no such flag\. .* without dashes, algo=cpo",
    'cost_limits={"cost": 3}': r"cannot be read.*have no quotes: '\{cost: 10\}'\.$",
    "PointGoal1": r"cannot be read.* written key=value, such as env=PointGoal1\.$",
    "cost_limits={cost:": r"cannot be read.*in quotes: cost_limits='\{cost: 10\}'\.$",
    # what another choice would read
    "risk.tail=0.2": r"there is no key 'risk\.tail' without risk=cvar\.$",
    "model.memory.size=8": r"without model=gru\.$",
    "transforms.saute.budgets={cost: 3}": r"without transforms=\[saute\]\.$",
    # choices that are none, or too many
    "algo=": r"no algo ''\. There are bc, .*; a file of yours needs --config-dir=FOLDER\.$",
    "algo=[cpo,ppo]": r"a run has one algo; for a run with each of them: -m algo=cpo,ppo$",
    "env=CartPole-v1": r"no env 'CartPole-v1'\. It is one of Gymnasium's: env=gymnasium env\.id",
    "env=gymnasium": r"^env\.id has to be given: env\.id=…$",
}


@pytest.fixture
def own_conf(tmp_path):
    """A folder of one's own with an algorithm and an environment."""
    for group in ("algo", "env"):
        (tmp_path / group).mkdir()
    (tmp_path / "algo" / "mine.yaml").write_text(
        "# @package _global_\ndefaults: [ppo_lagrangian, _self_]\n" + MINE
    )
    (tmp_path / "env" / "Nearby.yaml").write_text("defaults: [PointGoal1]\nhazards_num: 3\n")
    return tmp_path


@pytest.mark.parametrize("arguments", RIGHT, ids=" ".join)
def test_right_names_pass(arguments):
    read_command(arguments)


@pytest.mark.parametrize("argument", WRONG)
def test_wrong_names_name_the_right_ones(argument):
    with pytest.raises((CommandLineError, SettingError), match=WRONG[argument]) as caught:
        read_command(["logger=none", argument])
    assert len(str(caught.value).splitlines()) == 1


@pytest.mark.parametrize("choice", ["env.physics=warp", "preset=gpu"])
@pytest.mark.parametrize("family", ["SafeHopperVelocity", "gymnasium env.id=Walk-v0"])
def test_only_the_suite_runs_on_mujoco_warp(family, choice):
    with pytest.raises(
        (CommandLineError, ConfigError), match=r"'physics'.*runs on the CPU only\."
    ) as caught:
        read_command([*f"env={family}".split(), choice])
    assert len(str(caught.value).splitlines()) == 1


@pytest.mark.parametrize(
    ("algo", "override", "message"),
    [
        ("ppo", "lagrangian=pid", "algo=ppo has no 'lagrangian'"),
        ("ppo", "cost_advantage.gamma=0", "algo=ppo has no 'cost_advantage'"),
        ("ppo", "+limits=default", r"algo=ppo does not read 'limits'\. It keeps no limits"),
        ("cpo", "+lagrangian=pi", r"does not read 'lagrangian'\. Its loss has no multiplier"),
        ("p3o", "+lagrangian=pi", "algo=p3o does not read 'lagrangian'"),
    ],
)
def test_limits_and_multipliers_go_with_algorithms_that_have_them(algo, override, message):
    with pytest.raises(CommandLineError, match=message):
        read_command([f"algo={algo}", override])


def test_a_risk_measure_is_refused_where_no_limit_is_kept():
    read_command(["algo=cpo", "risk=cvar"])
    read_command(["algo=ppo", "risk=chance", "transforms=[saute]"])  # which is certified
    for words in (["algo=ppo", "risk=cvar"], ["-m", "algo=cpo,sac", "risk=cvar"]):
        with pytest.raises(CommandLineError, match=r"risk=cvar: algo=\w+ limits no costs"):
            read_command(words)


# files of one's own, each with what the line about it must name: the file, and the key or the place
FAULTY = {
    "defaults: [ppo, {override /lagrangian: pid}]": r"algo/mine': .*override 'lagrangian'",
    "defaults: [sac_lagrangian, {override /limits/replay: default}]": (
        r"algo/mine': .*Did you mean to override limits/replay@limits"
    ),
    "defaults: [ppo_lagrangien]": r"algo/mine\.yaml: there is no algo 'ppo_lagrangien'\.",
    # Hydra says it of the file whose choice is overridden
    "defaults: [ppo_lagrangian, {override /lagrangian: pidd}]": (
        r"algo/ppo_lagrangian\.yaml: there is no lagrangian 'pidd'\. Did you mean 'pid'\?"
    ),
    "defaults: [ppo_lagrangian, {/lagrangian: pid}]": "Multiple values for lagrangian",
    "defaults: {ppo: null}": r"Invalid defaults list in 'algo/mine'",
    "- 1": "algo/mine': ",
    "loss: {a: 1\nb: 2": r"mine\.yaml\", line 3",
    "frames: ${a": "full_key: frames",
    "frames: 3": "the file of algo= needs a line 'name: …'",
}


@pytest.mark.parametrize("text", FAULTY)
def test_faults_of_files_are_told_by_the_file(own_conf, text):
    (own_conf / "algo" / "mine.yaml").write_text(f"# @package _global_\n{text}\n")
    with pytest.raises(CommandLineError, match=FAULTY[text]) as caught:
        read_command([f"--config-dir={own_conf}", "algo=mine"])
    assert len(str(caught.value).splitlines()) == 1


def test_an_algorithm_below_its_own_name_is_refused(own_conf):
    file = own_conf / "algo" / "mine.yaml"
    file.write_text(file.read_text().partition("\n")[2])
    with pytest.raises(SettingError, match=r"^algo\."):
        read_command([f"--config-dir={own_conf}", "algo=mine"])


@pytest.mark.parametrize("flag", ["--config-dir=", "hydra.searchpath=[file://"])
def test_folders_of_ones_own_are_searched_too(own_conf, flag):
    folder = f"{flag}{own_conf}{']' if '[' in flag else ''}"
    read_command([folder, "algo=mine", "env=Nearby", "mine.tail=0.1", "+mine.more=1"])
    for wrong, meant in {
        "algo=mime": "Did you mean 'mine'",
        "env=Nearbye": "Did you mean 'Nearby'",
        "mine.tial=1": "Did you mean 'mine.tail'",
        "+frmaes=3": "Did you mean 'frames'",
        "mine.tail=abc": "mine.tail=abc: it must be a number",
    }.items():
        choice = [] if wrong.startswith("algo") else ["algo=mine"]
        with pytest.raises((CommandLineError, SettingError), match=meant):
            read_command([folder, *choice, wrong])


def test_a_folder_that_is_not_there_or_not_read(tmp_path):
    with pytest.raises(CommandLineError, match="no such folder"):
        read_command(["--config-dir", "nowhere"])
    for file in ("env/CarGoal1.yaml", "algo/cpo.yaml"):  # of the same names as built-in ones
        (tmp_path / file).parent.mkdir()
        (tmp_path / file).write_text("name: mine")
        with pytest.raises(CommandLineError, match=f"{file}: there is a built-in file"):
            read_command([f"--config-dir={tmp_path}"])
        (tmp_path / file).unlink()


def test_every_value_of_a_sweep_is_checked():
    for wrong in ("lagrangian.kp=0.1,nan", "+lr=1,2", "env=CarGoal2,CarGaol2", "hydra.run.dir=x"):
        with pytest.raises(ValueError, match=r"kp=nan|no key 'lr'|'CarGoal2'|write hydra\.sweep"):
            read_command(["-m", "seed=0,1", wrong])


@pytest.mark.parametrize("flags", [["-sc", "install=bash"], ["--help"]])
def test_questions_to_hydra_pass_untouched(flags):
    read_command([*flags, "no_such=key"])


def test_configurations_are_shown_with_wrong_values_but_not_with_wrong_names():
    read_command(["--cfg", "job", "seed=abc"])
    with pytest.raises(CommandLineError, match="Did you mean 'frames'"):
        read_command(["--cfg", "job", "frmaes=3"])


def test_a_wrong_key_beside_a_name_that_others_refer_to():
    with pytest.raises(CommandLineError, match=r"there is no key 'env\.cost_kyes'.*env\.cost_keys"):
        read_command(["env=gymnasium", "env.id=CartPole-v1", "env.cost_kyes=[cost_a]"])
