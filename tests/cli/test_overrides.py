"""Words on the command line: a wrong one is refused in one line that names what was meant."""

import re

import pytest
from commands import composed, status_of

from safe_rl.cli import train
from safe_rl.cli.composing import compose_run
from safe_rl.files import CONF
from safe_rl.scores.benchmark import SLATES

RIGHT = [
    ["-m", "env=PointGoal1,CarGoal2", "env.hazards_num=3,4", "seed=range(3)", "+note=a,b"],
    ["algo=trpo_lagrangian", "lagrangian=adam", "lagrangian.lr=0.1", "cost_limits={cost: 3}"],
    ["collector=process", "logger=none", "hydra.run.dir=x", "checkpoint.interval=5", "frames=3e5"],
    ["hydra/launcher=basic", "+policy_update.max_grad_norm=0.5", "model.input_scale={position: 2}"],
    ["algo=cpo", "policy_update={target_kl: 0.02}", "++seed=3"],
    ["-m", "algo=sac,td3", "seed=0"],
    ["algo=paper/cpo", "policy_update.target_kl=0.02"],
    ["-m", "algo=ppo,trpo,cup", "preset=gpu"],
    ["import=json", "algo=cpo", "--cfg", "job"],
    ["slate=SGPoint", "seed=0", "algo=cpo", "-m"],
    ["-m", "import=json", "seed=0,1", "--config-dir", "conf"],
    ["import=json", "--config-dir=conf", "env=PointGoal1", "seed=3"],
    ["algo=cpo", "-m", "seed=0,1", "--config-dir", "conf", "env=CarGoal1"],
    ["algo=cpo", "risk=cvar"],
    ["algo=ppo", "risk=chance", "transforms=[saute]"],  # which is certified
]
WRONG = {
    "env.hazard_num=3": r"^there is no key 'env.hazard_num'\. Did you mean 'env.hazards_num'\?$",
    "model._target_=my.nets": r"^there is no key .* yours .* added: '\+\+model\._target_=…'\.$",
    "lr=1e-4": "Did you mean 'policy_update.optimizer.lr' or 'critic_update.optimizer.lr'",
    "los.entropy_coeff=0.1": r"^there is no key 'los'\. Did you mean 'loss'\?$",
    "certificate={episodez: 5}": r"Did you mean '\S*certificate\.episodes'",
    "zzzzz=3": r"^there is no key 'zzzzz'\. '--cfg job' prints all .* added: '\+\+zzzzz=…'\.$",
    "env=PointGaol1": "no env 'PointGaol1'. Did you mean 'PointGoal1'",
    "env=zzzzz": r"no env 'zzzzz'\. 'python train.py --help' names all; a file of yours needs",
    "env=CartPole-v1": r"no env 'CartPole-v1'\. It is one of Gymnasium's: env=gymnasium env\.id",
    "env=gymnasium": r"^env\.id has to be given: env\.id=…$",
    "transforms=[saut]": "no transforms 'saut'. Did you mean 'saute'",
    "env.name=PointGoal2": "would train env=PointGoal1 under the name of .*write env=PointGoal2",
    "preset=hard_tasks": "^preset=hard_tasks: algo=ppo_lagrangian has no 'memory'. .*algo=sac_lag",
    "lagrangian=null": r"^there is no lagrangian 'null'\. There are adam, pi, pid",
    "+evaluation.interval=9": r"^evaluation: give both keys at once, evaluation='\{interval: ",
    "evaluation.interval=9": r"^evaluation: give both keys at once, evaluation='\{interval: ",
    "cost_limits.cost=10": r"^cost_limits\.cost: limits are .*, cost_limits='\{cost: 10\}'\.$",
    "limits={cost: 25}": r"^limits\.cost: limits are given together, cost_limits=",
    "limits=25": r"^limits=25: 'limits' is a section.* cost_limits='\{cost: 25\}'\.$",
    "loss=sac": r"^loss=sac: 'loss' is a section; its keys, .* one by one, loss\.<key>=…\.$",
    "logger=null": r"no logger 'null'\. Did you mean 'none'\?$",
    "+certificate.tail=0.1": r"^certificate\.tail: leave it out\. The tail is the risk's",
    "+mine=3": r"^there is no key 'mine'\. '--cfg job' prints all that there are\.$",
    "logger@mine=none": r"^Could not override 'logger@mine'\. Did you mean to override logger\?",
    "slate=SG7": "Unknown slate 'SG7'",
    "hydra.launcher=joblib": r"^hydra\.launcher=joblib: .* slash, hydra/launcher=joblib\.$",
    "frames=${nowhere}": "nowhere",
    "frames=[1": r"'frames=\[1' cannot be read",
    'cost_limits={"cost": 3}': r"cannot be read.*have no quotes: '\{cost: 10\}'\.$",
    "hydra.run.dir=a=b": r"cannot be read.*quotes: \"hydra\.run\.dir='a=b'\"\.$",
    "PointGoal1": r"cannot be read.* written key=value, such as env=PointGoal1\.$",
    "note={a: A (b)}": r"cannot be read.* need quotes: \"labels={a: 'A \(b\)'}\"\.$",
    "init_from=my run (1)": r"cannot be read.*quotes: \"init_from='my run \(1\)'\"\.$",
}
WRONG_TOGETHER = {
    # what only other algorithms or environments have
    ("algo=sac", "preset=gpu"): "^preset=gpu: algo=sac has no 'critic_update'",
    ("algo=paper/cpo", "preset=gpu"): "^preset=gpu: algo=cpo has no 'limits'",
    ("algo=ppo", "lagrangian=pid"): "^this algorithm has no 'lagrangian'",
    ("algo=sac", "critic_update.num_passes=3"): "^this algorithm has no 'critic_update'",
    ("algo=cpo", "limits=default"): "^limits=default: 'limits' is a section",
    ("env=SafeHopperVelocity", "algo=sac_lagrangian", "preset=privileged"): (
        r"^preset=privileged sets env\.observe_privileged, a key that .* does not have\.$"
    ),
    ("env=gymnasium", "algo=cpo", "preset=gpu"): r"^preset=gpu sets env\.physics, .* not have\.$",
    ("algo=ppo", "risk=cvar"): "^risk=cvar: algo=ppo limits no costs",
    ("-m", "algo=cpo,sac", "risk=cvar"): "^risk=cvar: algo=sac limits no costs",
    # how a key is written that only swept algorithms or a class of one's own have
    ("-m", "algo=p3o,appo", "loss.kappa=5"): r"of a sweep, is added: '\+\+loss\.kappa=…'",
    ("-m", "algo=cpo,sac", "memory.batch_size=8"): r"'\+\+memory\.batch_size=…'",
    ("loss._target_=mine.Loss", "loss.size=3"): r"'loss.size'\. .* added: '\+\+loss.size=…'\.$",
    # no advice that would fail
    ("-m", "transforms=[],[saute]", "transforms.saute.kappa=2"): r"'transforms\.saute'[^+]*$",
    ("cost_limits={cost: 5}", "limits.cost=3"): r"of a file: \+cost_limits\.cost=…$",
}
OF_ALL = "# @package _global_\n"


@pytest.mark.parametrize("arguments", RIGHT, ids=" ".join)
def test_right_words_pass(arguments):
    composed(*arguments)


def test_the_value_of_a_flag_is_no_override():
    words = ["--config-dir", "a=b", "-m", "slate=SG6", "seed=0"]
    assert train.prepare(words) == [f"env={','.join(SLATES['SG6'])}", "seed=0", *words[:3]]


def test_a_slate_and_a_single_environment_are_not_both_chosen():
    for other in ("env=PointGoal1", "slate=SGPoint", "resume=runs/mine"):
        with pytest.raises(ValueError, match="chooses the environments: leave out resume=, env="):
            train.prepare(["-m", "slate=SG6", other])
    assert "To sweep over it, add --multirun" in status_of("slate=SG6")


@pytest.mark.parametrize(
    ("words", "message"),
    [*(((word,), WRONG[word]) for word in WRONG), *WRONG_TOGETHER.items()],
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else "",
)
def test_wrong_words_name_the_right_ones(words, message):
    with pytest.raises(ValueError, match=message) as caught:
        composed("logger=none", *words)
    assert len(str(caught.value).splitlines()) == 1
    if words == ("env=gymnasium",):  # where Hydra names the folder of a run
        assert status_of(*words) == str(caught.value)


def test_an_algorithm_has_the_name_of_its_choice():
    """A merged mapping once trained PPO-Lagrangian as CPO."""
    (config,) = composed("algo={name: cpo}")
    assert config.algo.name == "ppo_lagrangian"


def test_an_algorithm_without_limits_takes_none_from_a_preset():
    (config,) = composed("algo=ppo", "preset=gpu")
    assert "limits" not in config


def test_a_file_that_hydra_would_not_read_is_refused(tmp_path):
    for group, name in (("algo", "p3o"), ("env", "PointGoal1"), ("transforms", "saute")):
        (tmp_path / group).mkdir()
        (tmp_path / group / f"{name}.yaml").write_text("loss: {kappa: 777}\n")
    for words in (["algo=p3o"], ["transforms=[action_delay,saute]"], ["transforms=saute"]):
        with pytest.raises(ValueError, match=r"\S+: \S+yaml would have no effect, because"):
            composed(f"--config-dir={tmp_path}", *words, "env=CarGoal1")
    with pytest.raises(ValueError, match=r"env=PointGoal1: the package has one .* Rename"):
        composed(f"--config-dir={tmp_path}")


def test_a_file_of_ones_own_may_come_before_that_of_the_package(tmp_path):
    (tmp_path / "algo").mkdir()
    for name in ("config.yaml", "algo/ppo.yaml"):
        (tmp_path / name).write_text((CONF / name).read_text())
    words = (f"--config-path={tmp_path}", f"hydra.searchpath=[file://{CONF}]", "algo=ppo")
    assert status_of(*words, "--cfg", "job") in (0, None)
    assert "frames=-1" in status_of(*words, "frames=-1")


def test_a_file_of_an_environment_without_its_name(tmp_path):
    (tmp_path / "env").mkdir()
    (tmp_path / "env" / "nameless.yaml").write_text("_target_: mine.make\n")
    told = "env: the file of an environment needs a line 'name: …'."
    assert status_of(f"--config-dir={tmp_path}", "env=nameless") == told
    with pytest.raises(ValueError, match=f"^{re.escape(told)}$"):
        compose_run(["env=nameless"], [tmp_path])


def test_an_id_with_a_namespace_names_one_folder():
    (config,) = composed("env=gymnasium", "env.id=ALE/Pong-v5")
    assert config.env.name == config.hydra.run.dir.split("/")[1] == "ALE-Pong-v5"


@pytest.mark.parametrize("flag", ["--config-dir=", "hydra.searchpath=[file://"], ids="ab")
def test_folders_of_ones_own_are_searched_too(tmp_path, flag):
    for group in ("algo", "env"):
        (tmp_path / group).mkdir()
    text = f"{OF_ALL}defaults: [ppo_lagrangian, _self_]\nalgo: {{tail: 0.25}}\n"
    text += "lagrangian: {init: '${algo.tail}'}\n"
    (tmp_path / "algo" / "mine.yaml").write_text(text)
    (tmp_path / "env" / "Nearby.yaml").write_text("defaults: [PointGoal1]\nhazards_num: 3\n")
    folder = f"{flag}{tmp_path}{']' if '[' in flag else ''}"
    (config,) = composed(folder, "algo=mine", "env=Nearby", "algo.tail=0.1")
    assert (config.algo.name, config.env.hazards_num, config.lagrangian.init) == ("mine", 3, 0.1)
    assert config.hydra.run.dir.startswith("runs/Nearby/mine/")
    assert config.hydra.sweep.subdir.startswith("Nearby/mine/")
    (tmp_path / "env" / "Nearby.yaml").write_text("defaults: [PointGoal1]\nname: Nearby\n")
    (tmp_path / "env" / "Crowd.yaml").write_text("defaults: [Nearby]\nhazards_num: 20\n")
    (config,) = composed(folder, "env=Crowd")
    assert config.env.name == config.hydra.run.dir.split("/")[1] == "Crowd"
    for wrong, meant in {
        "algo=mime": "Did you mean 'mine'",
        "env=Nearbye": "Did you mean 'Nearby'",
        "algo.tial=1": "Did you mean 'algo.tail'",
    }.items():
        choice = [] if wrong.startswith("algo=") else ["algo=mine"]
        with pytest.raises(ValueError, match=meant):
            composed(folder, *choice, wrong)
    given = ["--config-dir", str(tmp_path)] if flag.startswith("-") else [folder]
    assert "Did you mean 'env.hazards_num'" in status_of("env=Nearby", "env.hazard_num=3", *given)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        # it once trained P3O under the name of the user's loss
        ("defaults: [p3o]\nloss: {a: 1}\n", r"^algo\.loss: .* '# @package _global_'\.$"),
        (f"{OF_ALL}defaults: [p3o, lagrangian: pi]\n", r"write /lagrangian: pi\.$"),
        (f"{OF_ALL}algo: {{name: mine}}\n", r"^frames is missing: the .* algorithm sets it\.$"),
        (f"{OF_ALL}defaults: [p3p]", r"algo/mine\.yaml: there is no algo 'p3p'\."),
        (f"{OF_ALL}defaults: {{ppo: null}}", r"Invalid defaults list in 'algo/mine'"),
        (f"{OF_ALL}loss: {{a: 1\nb: 2\n", r"mine\.yaml\", line 3"),
    ],
)
def test_faults_of_files_are_told_by_the_file(tmp_path, text, message):
    (tmp_path / "algo").mkdir()
    (tmp_path / "algo" / "mine.yaml").write_text(text)
    with pytest.raises(ValueError, match=message) as caught:
        composed(f"--config-dir={tmp_path}", "algo=mine")
    assert len(str(caught.value).splitlines()) == 1
