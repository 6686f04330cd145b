"""Names that environments are made by: the families', what is stored, and what is not known."""

import gymnasium_envs  # noqa: F401, registers Walk-v0
import pytest
from hydra.core.config_store import ConfigStore

from safe_rl import trust
from safe_rl.envs import ConfigError, ContractError, make_env, store_config, store_configs
from safe_rl.envs.velocity import VelocityEnv
from safe_rl.trust import TargetError


@pytest.fixture(autouse=True)
def _as_before(monkeypatch):
    """What a test stores and allows is gone afterwards."""
    store_configs()  # once: later calls store only what has changed
    group = ConfigStore.instance().repo["env"]
    before = dict(group)
    monkeypatch.setattr(trust, "_ROOMS", dict(trust._ROOMS))
    yield
    group.clear()
    group.update(before)


def make_small(config, *, num_envs, **others):
    """A family of one's own, from another one, which may ignore how many it is asked for."""
    return VelocityEnv({"robot": "hopper", **config}, num_envs=min(num_envs, 3))


SMALL = f"{__name__}.make_small"


@pytest.mark.parametrize("name", ["SafeHopperVelocity-v0", "SafetyHopperVelocity-v1"])
def test_ids_of_the_velocity_family_are_names_too(name):
    assert make_env(name).config.robot == "hopper"


def test_what_is_stored_is_made_by_its_name():
    store_config("Crowded", {"robot_base": "point", "hazards_num": 11})
    assert make_env("Crowded", num_envs=4 / 2, seed=0).config.hazards_num == 11
    keys = {"id": "Walk-v0", "cost_keys": ["fast"], "num_steps": 4}
    store_config("Stroll", {"_target_": "safe_rl.envs.gymnasium.make_gymnasium", **keys})
    assert make_env("Stroll", num_envs=2, seed=0).max_episode_steps == 4
    store_config("Slow", {"_target_": SMALL, "velocity_threshold": 0.125})
    assert make_env("Slow", num_envs=2, seed=0).config.velocity_threshold == 0.125


def test_a_family_of_ones_own_is_made_once_its_module_is_trusted_as_storing_does():
    node = {"_target_": SMALL, "name": "mine"}
    with pytest.raises(TargetError, match=rf"env\._target_={SMALL}.*import={__name__}"):
        make_env(node)
    store_config("Slow", node)
    assert make_env(node, num_envs=3).batch_size == (3,)
    with pytest.raises(ContractError, match=r"made 3 environments, not num_envs=4"):
        make_env(node, num_envs=4)


@pytest.mark.parametrize("name", ["Safexp-PointGoal1-v0", "SafeHopperVelocity"])
def test_a_changed_configuration_is_made_and_stored(name):
    changed = make_env(name, seed=0).config.replace(num_steps=7)
    assert make_env(changed, num_envs=2, seed=0).config == changed
    store_config("Brief", changed)
    assert make_env("Brief", seed=0).config == changed
    with pytest.raises(ConfigError, match=r"a SafetyGymConfig; got a list"):
        make_env(["PointGoal1"])


def test_names_that_are_taken_or_unknown_are_refused():
    with pytest.raises(ConfigError, match="'PointGoal1' is a built-in environment"):
        store_config("PointGoal1", {"hazards_num": 3})  # make_env would make the built-in one
    with pytest.raises(ConfigError, match="seed=-1: it must be greater than or equal to 0"):
        make_env("PointGoal1", seed=-1)
    store_config("Crowded", {"robot_base": "point"})
    for name, nearest in (("PointGaol1", "PointGoal1"), ("Crowdd", "Crowded")):
        with pytest.raises(ConfigError, match=f"Did you mean '{nearest}'"):
            make_env(name)
