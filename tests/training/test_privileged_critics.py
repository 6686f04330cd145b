"""Critics that read what policies do not (`model.critic_observes`), on- and off-policy."""

import pytest
import torch
from run_configs import compose_config, without_times

import safe_rl
from safe_rl.algorithms.algorithm_contract import find_algorithm
from safe_rl.collectors.recording import read_recording
from safe_rl.envs import make_env
from safe_rl.evaluation import certify
from safe_rl.evaluation.loading import maker_of
from safe_rl.evaluation.settings import certificate_options
from safe_rl.models import RunningScale, update_running_scales

READ = {"model.critic_observes": ["observation", "privileged"], "env.observe_privileged": True}
SMALL = {"num_envs": 4, "frames_per_batch": 80, "frames": 240, "num_threads": 1, "seed": 3}
SMALL |= {"logger": "none", "env.num_steps": 20, "model.hidden_sizes": [8]}
SMALL |= {"certificate.episodes": 0, "checkpoint.interval": 0}
REPLAY = {"exploration.random_steps": 80, "memory.batch_size": 16, "memory.keep": True}
REPLAY |= {"evaluation": None, "policy_update.updates_per_step": 0.2}
BATCH = {"policy_update.minibatch_size": 40}
RUNS = {
    "sac": ("sac_lagrangian", {**REPLAY, "preset": "privileged", **SMALL}),
    "td3": ("td3_lagrangian", {**REPLAY, "memory.n_steps": 3}),
    "cal": ("cal", REPLAY),
    "cpo": ("cpo", {}),
    "dict": (
        "trpo_lagrangian",
        {"model": "dict", "model.normalise": 10, "env.observation_flatten": False},
    ),
    "gru": ("ppo_lagrangian", {**BATCH, "model": "gru"}),
    "workers": (
        "ppo_lagrangian", {**BATCH, "collector": "process", "collector.num_collectors": 2}
    ),
    "compiled": ("ppo_lagrangian", {**BATCH, "compile": True}),
}  # fmt: skip
SLOW = ("workers", "compiled", "td3", "cal")  # the last two build their critics as "sac" does


def train(folder, name, **more):
    algo, settings = RUNS[name]
    return safe_rl.train("PointGoal2", algo=algo, directory=folder, **(SMALL | settings | more))


def words(*more):
    settings = {key: x for key, x in SMALL.items() if "certificate" not in key} | READ
    return [*(f"{key}={str(x).replace(' ', '')}" for key, x in settings.items()), *more]


def make(*, known=True):
    return make_env("PointGoal2", num_envs=4, seed=0, num_threads=1, observe_privileged=known)


def algorithm_of(algo, env, *more, **model):
    config = compose_config("env=PointGoal2", *words(f"algo={algo}", *more))
    config.model.update(model)
    return find_algorithm(config).from_config(config, env)


@pytest.mark.parametrize("algo", ["sac_lagrangian", "cpo"])
def test_critics_read_it_and_the_policy_does_not(algo):
    env = make()
    algorithm = algorithm_of(algo, env)
    step = env.rollout(1)[:, 0]
    other = step.clone().set("privileged", step["privileged"] + 1)
    assert algorithm.policy.in_keys == ["observation"]
    for name in ("critic", "cost_critic"):
        critic = algorithm.networks[name]
        before, after = (critic(x.clone()).get(critic.out_keys[0]) for x in (step, other))
        assert (before != after).any()
    # as before without the key, and with the default
    for entry in (["observation"], None):
        critic = algorithm_of(algo, env, critic_observes=entry).networks["critic"]
        assert "privileged" not in critic.in_keys


@pytest.mark.parametrize("algo", ["sac_lagrangian", "cpo"])
def test_an_environment_without_it_is_refused(algo):
    with pytest.raises(ValueError, match=r"critic_observes.* Set env\.observe_privileged=true"):
        algorithm_of(algo, make(known=False))


@pytest.mark.long
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) if name in SLOW else name for name in RUNS]
)
def test_runs_learn_resume_and_act_without_it(name, tmp_path):
    whole = train(tmp_path / "whole", name, **READ)
    train(tmp_path / "halves", name, **READ, callbacks=[lambda row: row["epoch"] < 2])
    safe_rl.resume(tmp_path / "halves")
    table, expected = (without_times(tmp_path / n / "progress.csv") for n in ("halves", "whole"))
    assert len(table) == len(expected) == 4
    if name != "workers":  # whose environments begin new episodes in a resumed run
        assert table == expected
    plain = {"env": {"observe_privileged": False}, "num_threads": 1}
    result = safe_rl.evaluate(whole.directory, episodes=4, num_envs=2, **plain)
    assert result.estimates["episode_cost"].value >= 0


@pytest.mark.long
def test_the_entry_alone_changes_nothing(tmp_path):
    tables = []
    for known in (False, True):
        folder, more = tmp_path / str(known), {"env.observe_privileged": known}
        safe_rl.train("PointGoal2", algo="cpo", directory=folder, **SMALL, **more)
        tables.append(without_times(folder / "progress.csv"))
    assert tables[0] == tables[1]


def test_its_columns_are_normalised():
    env = make()
    algorithm, batch = algorithm_of("ppo", env, "model.normalise=10"), env.rollout(5)
    update_running_scales(algorithm.networks.values(), batch)
    scales = [m for m in algorithm.critic.modules() if isinstance(m, RunningScale)]
    assert [scale.key for scale in scales] == ["observation", "privileged"]
    mean = batch["privileged"].flatten(0, 1).double().mean(0)
    torch.testing.assert_close(scales[1].mean, mean)


@pytest.mark.long
def test_a_policy_is_certified_without_it(tmp_path):
    run = train(tmp_path / "run", "sac", **READ, cost_limits={"cost": 15})
    made = []

    def make_without(node, **others):
        made.append(maker_of(run)({**node, "observe_privileged": False}, **others))
        return made[-1]

    options = certificate_options(run.config, {"ranking": 4, "episodes": 200, "tests": 1})
    certificate = certify(run.directory, options, make_env=make_without, num_threads=1)
    assert certificate.checkpoint is not None
    assert certificate.verdict.bounds["mean_cost"][0] < 15
    assert made
    assert not any(env.privileged_layout for env in made)


@pytest.mark.long
def test_offline_data_must_have_it(tmp_path):
    known = train(tmp_path / "known", "td3", **READ, record=True).directory / "transitions"
    assert read_recording(known)["next", "privileged"].shape[-1] == 105
    plain = train(tmp_path / "plain", "td3", record=True).directory / "transitions"
    offline = {"dataset.alone": True, "exploration.random_steps": 0, "memory.n_steps": 1}
    run = train(tmp_path / "offline", "td3", **READ, **offline, **{"dataset.path": str(known)})
    assert sum(run.table["policy_num_updates"]) > 0
    with pytest.raises(ValueError, match=r"no privileged, which critics read: .*critic_observes"):
        train(tmp_path / "no", "td3", **READ, **offline, **{"dataset.path": str(plain)})
