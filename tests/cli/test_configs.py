"""Every configuration file composes, and algo=paper/… has the paper's numbers."""

import itertools
import sys

import pytest
from commands import composed, status_of
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from point_mass import PointMass
from run_configs import CONF, compose_config, nodes

from safe_rl import trust
from safe_rl.algorithms.algorithm_contract import find_algorithm
from safe_rl.algorithms.constraints import check_cost_limits
from safe_rl.checks import is_setting, parameters_of
from safe_rl.cli import train
from safe_rl.cli.config import check_settings
from safe_rl.envs import EXTRAS, SUITE, env_names, env_node, store_configs


def options(group: str) -> list[str]:
    return sorted(path.stem for path in (CONF / group).glob("*.yaml"))


ALGORITHMS = options("algo")
PAPER = options("algo/paper")
# presets with an algorithm of every structure
CHOICES = [
    *([f"algo={name}"] for name in ALGORITHMS),
    *([f"algo={name}", "preset=hard_tasks"] for name in ("sac", "td3_lagrangian", "wcsac")),
    *([f"algo={name}", "preset=gpu"] for name in ("ppo", "trpo", "cpo", "focops", "cup")),
]
# of the groups that only some algorithms have
LAGRANGIAN = [
    name for name in ALGORITHMS if "- /lagrangian:" in (CONF / "algo" / f"{name}.yaml").read_text()
]


def assert_every_setting_has_a_range_or_choices(path, node):
    known = parameters_of(trust.locate(node._target_))
    for name, value in node.items():
        is_part = OmegaConf.is_dict(value) and "_target_" in value
        if name[0] != "_" and not is_part and value is not None:
            assert is_setting(known[name].annotation), f"{path}.{name}"


@pytest.mark.parametrize(
    ("choices", "env"),
    [*zip(CHOICES, itertools.cycle(["PointGoal1", "CarButton2", "DoggoPush0"]), strict=False)],
    ids=str,
)
def test_every_combination_resolves_and_builds(choices, env):
    config = compose_config(f"env={env}", *choices)
    check_settings(config)
    plain = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    algo = choices[0].removeprefix("algo=")
    assert plain["env"]["name"] == env
    assert plain["algo"]["name"] == algo
    # episodes of 1000 steps: whole ones, or rows that begin at different points of theirs
    steps = plain["frames_per_batch"] / plain["num_envs"]
    assert steps == plain["env"]["num_steps"] or plain["staggered_starts"]
    assert plain["frames_per_batch"] % plain["num_envs"] == 0
    for path, node in nodes(config):
        if path != "algo" and str(node.get("_target_")).startswith("safe_rl."):
            assert_every_setting_has_a_range_or_choices(path, node)
    OmegaConf.update(config, "env", {"name": "PointMass", "robot_base": "point"}, merge=False)
    if config.get("dataset", {}).get("alone"):
        with pytest.raises(ValueError, match=r"dataset\.path is missing"):
            find_algorithm(config).from_config(config, PointMass(2))
        return
    algorithm = find_algorithm(config).from_config(config, PointMass(2))
    assert ("cost_critic" in algorithm.networks) == bool(algorithm.constraints.keys)
    assert (algorithm.multiplier is not None) == (algo in LAGRANGIAN)


def test_presets_replace_keys_of_an_algorithm():
    config = compose_config("algo=ppo_lagrangian", "preset=gpu", "env=PointGoal1", "num_envs=8")
    assert (config.env.physics, config.num_envs) == ("warp", 8)
    assert config.policy_update.minibatch_size == config.critic_update.minibatch_size == 16_384
    config = compose_config("algo=sac_lagrangian", "preset=hard_tasks")
    assert list(config.transforms) == ["observed_costs", "action_repeat"]
    assert (config.loss.gamma, config.memory.n_steps) == (0.98, 3)
    config = compose_config("algo=sac_lagrangian", "preset=privileged")
    assert list(config.transforms) == ["action_repeat"]
    assert config.env.observe_privileged == ["last_costs", "cost_traces"]
    assert config.model.critic_observes == ["observation", "privileged"]


@pytest.mark.parametrize(
    ("multiplier", "algo"), [*zip(options("lagrangian"), itertools.cycle(LAGRANGIAN), strict=False)]
)
def test_multipliers_are_interchangeable(multiplier, algo):
    names = (f"algo={algo}", f"lagrangian={multiplier}")
    config = compose_config("env=PointMass", *names)
    assert config.lagrangian == OmegaConf.load(CONF / "lagrangian" / f"{multiplier}.yaml")
    find_algorithm(config).from_config(config, PointMass(2))


def test_every_environment_is_an_option_and_a_node_with_all_keys():
    assert {*SUITE, *EXTRAS} <= set(env_names())
    assert len(SUITE) == 27
    for name in ("PointGoal1", "DoggoPush2Vision", "CarRun"):
        config = compose_config(f"env={name}")
        assert config.env == env_node(name)


def test_the_help_lists_every_environment(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["train.py", "--help"])
    with pytest.raises(SystemExit) as end:
        train.main()
    store_configs()  # the help has stored names alone
    assert not end.value.code
    help_text = capsys.readouterr().out
    assert all(name in help_text for name in (*SUITE, *EXTRAS, "gymnasium"))
    assert (
        f"hazards_num: {env_node('PointGoal1')['hazards_num']}" in help_text
    )  # the default's keys


def test_the_help_has_the_keys_of_a_file_that_builds_on_an_environment(tmp_path):
    (tmp_path / "env").mkdir()
    (tmp_path / "env" / "crowd.yaml").write_text("defaults: [CarGoal1]\nhazards_num: 17\n")
    train.prepare(["--help", f"--config-dir={tmp_path}", "env=crowd"])
    # with what is now in the store; the help itself would take half a minute
    with initialize_config_dir(str(CONF), version_base="1.3"):
        env = compose("config", [f"hydra.searchpath=[file://{tmp_path}]", "env=crowd"]).env
    assert (env.hazards_num, env.robot_base) == (17, "car")


def test_limits_of_a_file_take_the_place_of_the_default(tmp_path):
    (tmp_path / "experiment").mkdir()
    text = "# @package _global_\ncost_limits: {cost_hazards: 10}\n"
    (tmp_path / "experiment" / "mine.yaml").write_text(text)
    words = [f"--config-dir={tmp_path}", "env=PointGoal1"]
    for more, limits in (
        ([], {"cost": 25}),
        (["cost_limits={cost_hazards: 3}"], {"cost_hazards": 3}),
        (["+experiment=mine"], {"cost_hazards": 10}),
        (["+experiment=mine", "cost_limits.cost_hazards=5"], {"cost_hazards": 5}),
        (["cost_limits={}", "algo=ppo"], {}),
    ):
        (config,) = composed(*words, *more)
        assert config.cost_limits == limits
    message = "To add this one to those of a file: +cost_limits.cost_vases=…"
    assert message in status_of(*words, "+experiment=mine", "cost_limits={cost_vases: 3}")
    message = "experiment: nothing is chosen that it could replace; add it, +experiment=…"
    assert status_of(*words, "experiment=mine") == message


# The whole of what decides how a run of algo=paper/… learns, from the paper's section 5.2 and the
# code published with it. A number that is in the configuration and not here fails the tests.
ADAM = {"_target_": "torch.optim.Adam", "_partial_": True, "fused": True}
DISCOUNT = {"gamma": 0.99, "lmbda": 0.97, "value_target": "return_to_go"}
FULL_BATCH = {
    "_target_": "safe_rl.algorithms.MinibatchUpdate", "num_passes": 80, "minibatch_size": None,
    "compile": False,
}  # fmt: skip
SHARED = {
    "model": {
        "hidden_sizes": [256, 256],
        "initial_log_std": -0.5,
        "input_scale": {},
        "critic_observes": ["observation"],
        "head": "auto",
        "normalise": None,
        "encoders": None,
        "memory": None,
    },
    "advantage": {"_target_": "safe_rl.objectives.VectorGAE", **DISCOUNT},
    "critic_update": {**FULL_BATCH, "optimizer": {**ADAM, "lr": 1e-3}},
    "cost_limits": {"cost": 25.0},
    "risk": {"_target_": None},
}
COSTS = {"cost_advantage": {"_target_": "safe_rl.objectives.CostGAE", **DISCOUNT}}
MULTIPLIER = {
    "lagrangian": {"_target_": "safe_rl.objectives.LagrangeMultiplier", "init": 1.0, "lr": 0.05}
}
STOP = {"max_kl": 1.2 * 0.01, "step_beyond_kl": True}
PPO = {"policy_update": {**FULL_BATCH, "optimizer": {**ADAM, "lr": 3e-4}, **STOP}}
TRUST_REGION = {
    "target_kl": 0.01, "damping": 0.1, "cg_iterations": 10, "backtrack_coeff": 0.8,
    "max_backtracks": 10,
}  # fmt: skip
TRPO = {"policy_update": {"_target_": "safe_rl.algorithms.TRPOStep", **TRUST_REGION}}
CPO = {
    "policy_update": {
        "_target_": "safe_rl.algorithms.CPOStep", **TRUST_REGION,
        "largest_required_decrease": None,
    }
}  # fmt: skip
NUMBERS = {
    "ppo": SHARED | PPO,
    "ppo_lagrangian": SHARED | PPO | COSTS | MULTIPLIER,
    "trpo": SHARED | TRPO,
    "trpo_lagrangian": SHARED | TRPO | COSTS | MULTIPLIER,
    "cpo": SHARED | CPO | COSTS,
}
LOSSES = {
    "ppo": {"_target_": "safe_rl.objectives.PPOLoss", "clip_epsilon": 0.2},
    "ppo_lagrangian": {
        "_target_": "safe_rl.objectives.PPOLagrangianLoss",
        "clip_epsilon": 0.2,
        "cost_clipping": "none",
    },
    "trpo": {"_target_": "safe_rl.objectives.TRPOLoss"},
    "trpo_lagrangian": {"_target_": "safe_rl.objectives.TRPOLagrangianLoss"},
    "cpo": {"_target_": "safe_rl.objectives.CPOLoss"},
}
# per environment: steps in all, environments, steps per epoch
SIZES = {
    "PointGoal1": (10_000_000, 30, 30_000),
    "CarPush2": (10_000_000, 30, 30_000),
    "DoggoButton1": (100_000_000, 60, 60_000),
}
# what is no part of the algorithm, and the tables that other keys read
ASIDE = {
    *("collector", "env", "algo", "preset", "logger", "seed", "device", "num_threads", "compile"),
    *("certificate", "checkpoint", "default_cost_limits", "import", "paper", "record"),
    "transforms",
}


@pytest.mark.parametrize(
    ("algo", "env"),  # the sizes depend on the robot alone
    [*((name, "PointGoal1") for name in PAPER), ("ppo", "CarPush2"), ("ppo", "DoggoButton1")],
)
def test_the_numbers_of_the_paper(algo, env):
    config = compose_config(f"algo=paper/{algo}", f"env={env}")
    check_settings(config)
    plain = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    # a switch that is off, such as one to start from another run, is null
    found = {k: v for k, v in plain.items() if k not in ASIDE and v is not None}
    sizes = dict(zip(("frames", "num_envs", "frames_per_batch"), SIZES[env], strict=True))
    assert found == NUMBERS[algo] | sizes | {"loss": {**LOSSES[algo], "entropy_coeff": 0.0}}
    OmegaConf.update(config, "env", {"name": "PointMass", "robot_base": "point"}, merge=False)
    find_algorithm(config).from_config(config, PointMass(2))


def test_a_robot_of_ones_own_has_the_numbers_of_point():
    config = compose_config("algo=paper/ppo", "env=PointMass", "env.robot_base=xmls/mine.xml")
    assert (config.frames, config.num_envs, config.frames_per_batch) == (10_000_000, 30, 30_000)


def test_cost_limits_must_name_costs_of_the_environment():
    keys = ["cost", "cost_hazards", "cost_vases_contact"]
    assert check_cost_limits({"cost_hazards": 10}, keys) == {"cost_hazards": 10.0}
    with pytest.raises(ValueError, match="Did you mean 'cost_hazards'"):
        check_cost_limits({"cost_hazard": 10}, keys)
    with pytest.raises(ValueError, match=r"no such cost\. It has cost, "):  # nothing like it
        check_cost_limits({"cost_pillars": 10}, keys)
