"""Wrong names on the command line are refused before Hydra sees them, right ones are not."""

import pytest
from omegaconf import OmegaConf
from run_configs import CONF, compose_config

from safe_rl.cli.overrides import CommandLineError, check_overrides
from safe_rl.envs import store_configs

ENV_KEYS = ["hazards_num", "hazards_size", "num_steps"]
RIGHT = [
    ["-m", "env=PointGoal1,CarPush2", "env.hazards_num=3,4", "+env.num_steps=5"],
    ["algo=cpo,ppo", "preset=paper", "frames=30_000", "policy_update.target_kl=0.02"],
    ["algo=trpo_lagrangian", "lagrangian=adam", "lagrangian.lr=0.1", "cost_limits={cost: 3}"],
    [
        "lagrangian=pid",
        "collector=process",
        "logger=none",
        "hydra.run.dir=x",
        "checkpoint.interval=5",
    ],
    ["+frmaes=3", "~logger", "hydra/launcher=basic", "policy_update/ppo@policy_update=paper"],
    ["--config-dir=mine", "algo=mine", "mine.tail=0.1"],
]
WRONG = {
    "env.hazard_num=3": r"no key 'hazard_num'\. Did you mean 'env\.hazards_num'",
    "frmaes=3": "no key 'frmaes'. Did you mean 'frames'",
    "presett=paper": "Did you mean 'preset'",
    "policy_update.target_kll=1": "Did you mean 'target_kl'",
    "env=PointGaol1": "no env 'PointGaol1'. Did you mean 'PointGoal1'",
    "env=CarGoal1,CarGaol2": "no env 'CarGaol2'. Did you mean 'CarGoal2'",
    "algo=cop": "no algo 'cop'. Did you mean 'cpo'",
    "preset=papers": "Did you mean 'paper'",
    "cost_limits.cost=10": r"cost_limits='\{cost: 10\}'",
}


@pytest.fixture(autouse=True)
def _environments():
    store_configs()


@pytest.mark.parametrize("arguments", RIGHT)
def test_right_names_pass(arguments):
    check_overrides(arguments, CONF, ENV_KEYS)


@pytest.mark.parametrize("argument", WRONG)
def test_wrong_names_name_the_nearest(argument):
    with pytest.raises(CommandLineError, match=WRONG[argument]):
        check_overrides(["seed=0", "hydra.run.dir=x", argument], CONF, ENV_KEYS)


@pytest.mark.parametrize("algo", ["ppo", "trpo", "cpo", "ppo_lagrangian,cpo"])
def test_multipliers_go_with_algorithms_that_have_them(algo):
    with pytest.raises(CommandLineError, match=r"no multiplier.*ppo_lagrangian and trpo_lagr"):
        check_overrides([f"algo={algo}", "lagrangian=pid"], CONF, ENV_KEYS)


@pytest.mark.parametrize("path", [*(CONF / "algo").glob("*.yaml")], ids=lambda path: path.stem)
def test_every_key_of_every_algorithm_passes(path):
    config = OmegaConf.to_container(compose_config(f"algo={path.stem}"))
    groups = {group.name for group in CONF.glob("*/")}
    keys = [key for key in dotted(config) if key not in {"env", "cost_limits", *groups}]
    assert len(keys) > 40
    check_overrides([f"{key}=1" for key in keys], CONF, ENV_KEYS)


def dotted(node, prefix=""):
    """Every key of a configuration but those of the environment and the limits."""
    for key, value in node.items():
        yield f"{prefix}{key}"
        if isinstance(value, dict) and key not in ("env", "cost_limits"):
            yield from dotted(value, f"{prefix}{key}.")
