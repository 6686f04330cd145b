"""One table of what keys are for: against the configurations that there are."""

from functools import cache

import pytest
from omegaconf import OmegaConf
from run_configs import CONF, compose_config

from safe_rl.cli.folders import job_name
from safe_rl.runs.identity import RESUMABLE, ROLES, Role, differences, experiment_of, role_of


def nodes(config, prefix=""):
    for key, value in config.items():
        yield f"{prefix}{key}"
        if isinstance(value, dict):
            yield from nodes(value, f"{prefix}{key}.")


@cache
def as_saved(*overrides):
    return OmegaConf.to_container(compose_config("env=PointMass", *overrides), resolve=True)


@pytest.fixture(scope="module")
def all_keys():
    keys = {*nodes(as_saved()), "note"}  # which no file has
    for path in CONF.rglob("*.yaml"):
        below = "" if "_global_" in path.read_text() else f"{path.parent.name}."
        if path.parent != CONF:
            keys |= {*nodes(OmegaConf.to_container(OmegaConf.load(path)), below)}
    return keys


def test_every_row_is_about_a_key_that_exists(all_keys):
    for row in ROLES:
        if row.startswith("*."):
            assert any(key.endswith(row[1:]) for key in all_keys)
        else:
            assert row in all_keys or row.startswith("env.")


def test_folders_of_a_sweep_name_all_but_the_machine_and_what_is_in_the_path(all_keys):
    words = [f"{key}=1" for key in all_keys]
    kept = {key for key in all_keys if role_of(key) is not Role.MACHINE} - {"env", "algo", "seed"}
    for word in words:
        assert job_name([word]) == (word if word[:-2] in kept else "")


@pytest.mark.parametrize(
    ("key", "role"),
    [
        ("policy_update.adapt_rate.factor", Role.LEARNING),
        ("policy_update._target_", Role.EXPERIMENT),
        ("policy_update.rates.log_alpha", Role.EXPERIMENT),  # the optimiser's, which is restored
        ("loss.gamma", Role.LEARNING),
        ("loss.alpha_init", Role.EXPERIMENT),
        ("logger._target_", Role.MACHINE),
        ("note", Role.MANNER),
        ("collector._target_", Role.MANNER),
        ("mine", Role.EXPERIMENT),
    ],
)
def test_a_key_has_the_role_of_the_nearest_row(key, role):
    assert role_of(key) is role


ELSEWHERE = ("num_threads=2", "device=meta", "compile=true", "logger=none", "collector=process")
OTHERS = ("frames=7", "policy_update.max_kl=0.1", "cost_limits={cost: 3}", "env.name=Other")


@pytest.mark.parametrize("override", ["seed=3", *ELSEWHERE, *OTHERS, "transforms=[saute]"])
def test_all_but_seeds_and_machines_make_another_experiment(override):
    is_same = override in ("seed=3", *ELSEWHERE)
    assert (experiment_of(as_saved(override)) == experiment_of(as_saved())) is is_same


def test_whether_transitions_are_kept_makes_no_other_experiment():
    kept = as_saved("algo=sac", "memory.keep=true")
    assert experiment_of(kept) == experiment_of(as_saved("algo=sac"))
    assert role_of("memory.keep") not in RESUMABLE


def test_the_order_of_transforms_does():
    orders = ("saute,sensor_noise", "sensor_noise,saute")
    first, second = (experiment_of(as_saved(f"transforms=[{names}]")) for names in orders)
    assert first != second


def begun_from(run):
    return experiment_of(as_saved() | {"init_from": f"runs/{run}"})


def test_runs_from_the_networks_of_several_seeds_are_one_experiment():
    for pattern in ("small/seed{}", "small/2026-01-3{0}_12-0{0}-00_seed{0}_2", "small_seed{}"):
        first, second = (begun_from(pattern.format(seed)) for seed in (0, 1))
        assert first == second != begun_from("large/seed0")
    assert begun_from("goal1") != begun_from("goal2")


def test_a_sweep_continues_an_archived_run_that_lacks_the_kind_of_physics():
    before = as_saved()
    now = {**before, "env": {**before["env"], "physics": "cpu", "physics_buffers": 2.0}}
    assert experiment_of(before) == experiment_of(now)
    assert not differences(before, now)
    assert differences(now, as_saved("frames=5", "num_threads=7", "lagrangian.kp=0.5")) == {
        "lagrangian.kp": (now["lagrangian"]["kp"], 0.5)
    }
