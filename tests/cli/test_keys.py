"""No value of a setting whatever ends in a traceback."""

import math
from collections.abc import Iterator
from functools import cache
from typing import Any

import pytest
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from point_mass import PointMass
from run_configs import CONF, compose_config, nodes

import safe_rl.objectives
from safe_rl import trust
from safe_rl.algorithms.algorithm_contract import find_algorithm
from safe_rl.cli.config import check_settings
from safe_rl.training.train import SETTING_ERRORS

ALGORITHMS = sorted(path.stem for path in (CONF / "algo").glob("*.yaml"))
WRONG: list[Any] = [
    *("abc", "", "a\nb", None, True, math.nan, math.inf, -math.inf, -1, 0, 0.5, 1.5),
    *(1e9, 1e300, 10**30, [], {}, [math.nan], ["a"], {"a": math.nan}, {"_target_": "os.system"}),
]


@cache
def config_of(algo: str) -> Any:
    """The checked configuration of an algorithm for the point mass."""
    config = compose_config(f"algo={algo}", "env=PointMass", "model.hidden_sizes=[4]")
    check_settings(config)
    return config


def outcome(config: Any, path: str, value: Any) -> str:
    """What a value of a key leads to: the words of a refusal, or nothing."""
    changed = config.copy()
    try:
        OmegaConf.update(changed, path, value, merge=False, force_add=True)
        check_settings(changed)
        find_algorithm(changed).from_config(changed, PointMass(2))
    except OmegaConfBaseException as error:  # the types of `General`
        return str(error).splitlines()[0]
    except SETTING_ERRORS as error:
        return str(error)
    return ""


def values_of_parts() -> Iterator[tuple[Any, str]]:
    """Every key of every part once, with a configuration that has it."""
    seen = set()
    for config in map(config_of, ALGORITHMS):
        for path, node in nodes(config):
            for key in node:
                if (path, key, node.get("_target_")) not in seen:
                    seen.add((path, key, node.get("_target_")))
                    yield config, f"{path}.{key}"


@pytest.mark.slow
def test_no_value_ends_in_a_traceback():
    accepted: dict[str, list[Any]] = {}
    for config, path in values_of_parts():
        for value in WRONG:
            words = outcome(config, path, value)
            assert len(words.splitlines()) <= 1, words
            if not words:
                accepted.setdefault(path, []).append(value)
    assert 0.5 in accepted["advantage.gamma"]
    assert 1.5 not in accepted["advantage.gamma"]


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        ("frames", "abc", "frames=abc: it must be a valid integer"),
        ("frames", "25", "frames='25': it must be a valid integer"),
        ("frames", 2.5, "frames=2.5: it must be a valid integer"),
        ("num_envs", 0, "num_envs=0: it must be greater than or equal to 1"),
        ("model.memory", "a\nb", "model.memory must have the keys size"),
        ("loss", None, "loss=null: the loss of an algorithm"),
        ("limits.free_steps", [], "limits.free_steps=[]: it must be"),
        ("seed", True, "Value 'True' of type 'bool' could not be converted to Integer"),
        ("advantage.gamma", 2, "advantage.gamma=2: it must be less than or equal to 1"),
        ("advantage.gama", 2, "gama: VectorGAE has no such argument. Did you mean 'gamma'"),
        ("policy_update.adapt_rate.factor", 1, "adapt_rate.factor=1: it must be greater than 1"),
        ("lagrangian.init", True, "lagrangian.init=true: it must be"),
        ("policy_update.optimizer.lr", -1, "policy_update: Invalid learning rate: -1"),
        ("loss.clip_epsilon", math.nan, "loss.clip_epsilon=nan: it must be a finite number"),
        ("model.initial_log_std", None, "model.initial_log_std=null: it must be a valid number"),
        ("model.hidden_sizes", 64, "model.hidden_sizes=64: it must be a valid list"),
        ("model.hiden_sizes", [64], "key 'model.hiden_sizes'. Did you mean 'model.hidden_sizes'?"),
        ("certificate.cap", 25, "certificate.cap=25: it must be above every limit of"),
        ("collector.num_collectors", 4, "use collector=process or collector=ray"),
        ("device", "cuda:99", "device=cuda:99: it must be cpu; or cuda or cuda:<number>, if torch"),
        ("env.name", "a/b", "env.name=a/b: it must be a name of a folder, without /"),
        ("cost_limits", {"cost": math.inf}, "{'cost': inf}: it must be a finite number"),
        ("cost_limits", {"cost": -1}, "{'cost': -1}: it must be greater than or equal to 0"),
        ("loss._target_", "torch.load", "loss._target_=torch.load: configurations reach only"),
    ],
)
def test_refusals_name_the_key_and_what_it_may_hold(path, value, words):
    assert words in outcome(config_of("ppo_lagrangian"), path, value)


def test_whole_numbers_may_be_written_with_exponents():
    config = config_of("ppo").copy()
    config.frames, config.policy_update.num_passes = 3e5, 1e1
    check_settings(config)
    assert repr(config.frames) == "300000"
    update = find_algorithm(config).from_config(config, PointMass(2)).policy_update
    assert repr(update.num_passes) == "10"


class OwnMultiplier(safe_rl.objectives.PIMultiplier):
    """A part of one's own, with an argument more."""

    def __init__(self, cost_limits, *, patience, **kwargs):
        super().__init__(cost_limits, **kwargs)


def test_parts_of_ones_own_are_checked_by_what_they_inherit(monkeypatch):
    monkeypatch.setitem(trust._ROOMS, __name__, None)
    config = config_of("ppo_lagrangian").copy()
    config.lagrangian._target_ = f"{__name__}.OwnMultiplier"
    assert "'patience'" in outcome(config, "note", "none")
    OmegaConf.update(config, "lagrangian.patience", "anything", force_add=True)
    assert not outcome(config, "note", "none")
    assert "lagrangian.kp=nan: it must be" in outcome(config, "lagrangian.kp", math.nan)


def test_an_algorithm_that_compiles_nothing_says_so():
    with pytest.warns(UserWarning, match="compile has no effect: algo=sac"):
        check_settings(compose_config("algo=sac", "compile=true"))
