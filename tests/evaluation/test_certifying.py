"""The certificate of a run on the point mass, whose costs are known to be kept or broken."""

import json
import math
import re
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from point_mass import PointMass
from run_configs import point_mass_config

from safe_rl import envs
from safe_rl.evaluation import Certificate, CertificateOptions, certify
from safe_rl.evaluation.certifying import _RANKING, _run, _write
from safe_rl.evaluation.measuring import Trial
from safe_rl.evaluation.settings import EvaluationOptions
from safe_rl.reporting.recorded import read_certificate
from safe_rl.runs.run import Run
from safe_rl.scores.certificate import Verdict
from safe_rl.training.building import build_trainer, seed_everything

pytestmark = pytest.mark.long

OPTIONS = CertificateOptions(ranking=6, episodes=120, tests=2, level=0.95, most_over=1.0)


class Bounded(PointMass):
    """An episode has 20 steps, each of which costs at most 1."""

    def highest_cost(self, key):
        return 20.0


def make_env(node, *, num_envs, device, seed, num_threads):
    return Bounded(num_envs, 20, seed % 1000)


@pytest.fixture
def train(tmp_path):
    def train(limits, *overrides):
        config = point_mass_config(f"cost_limits={limits}", "checkpoint.interval=0", *overrides)
        seed_everything(config.seed, None)
        env = PointMass(config.num_envs, 20, config.seed)
        build_trainer(config, env, tmp_path / "run").run()
        return tmp_path / "run"

    return train


def test_a_policy_that_keeps_its_limit_is_certified_and_kept(train):
    directory = train("{cost: 19}")
    certificate = certify(directory, OPTIONS, make_env=make_env)
    written = json.loads((directory / "certificate.json").read_text())
    assert written["certified"]
    assert written["bounds"]["mean_cost"]["bound"] < written["bounds"]["mean_cost"]["most"] == 19
    # the last two epochs, and the best three: several files may be of the same epoch
    assert len(written["candidates"]) == len(set(written["candidates"])) >= 2
    assert Run(directory).find_checkpoint("certified") == certificate.checkpoint
    assert certificate.checkpoint.read_bytes()
    line = str(certificate)
    assert re.match(
        r"Certified at 95% with sampled actions: mean_cost ≤ [\d.]+ "
        r"\([\d.]+ in 1\d\d new episodes\), return ",
        line,
    )
    assert "The bound includes rare episodes that cost up to 20." in line
    torch.rand(3)
    assert certify(directory, OPTIONS, make_env=make_env) == certificate
    student = certify(directory, replace(OPTIONS, bound="student"), make_env=make_env)
    assert "assumes that no rare episodes cost far more" in str(student)


def test_mean_actions_are_certified_as_such(train):
    directory = train("{cost: 19}")
    sampled = certify(directory, OPTIONS, make_env=make_env)
    assert not json.loads((directory / "certificate.json").read_text())["deterministic"]
    mean = certify(directory, replace(OPTIONS, deterministic=True), make_env=make_env)
    assert json.loads((directory / "certificate.json").read_text())["deterministic"]
    assert "Certified at 95% with mean actions: " in str(mean)
    assert mean.episode_return != sampled.episode_return


def test_none_is_certified_where_limits_are_broken_and_it_says_by_how_much(train):
    directory = train("{cost_hazards: 0.01}")
    certificate = certify(directory, OPTIONS, make_env=make_env)
    assert certificate.checkpoint is None
    assert certificate.verdict.shortfalls["mean_cost_hazards"] > 0.1
    assert len(certificate.verdict.tested) == 2
    assert "mean_cost_hazards ≤ " in str(certificate)
    with pytest.raises(FileNotFoundError, match="none of its policies has been certified"):
        Run(directory).find_checkpoint("certified")


def test_a_certified_policy_is_replaced_whole_or_taken_back(train, monkeypatch):
    directory = train("{cost: 19}")
    before = certify(directory, OPTIONS, make_env=make_env).checkpoint
    content = before.read_bytes()

    def interrupt(source, target):
        target.write_bytes(source.read_bytes()[:100])
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr("shutil.copy2", interrupt)
        with pytest.raises(KeyboardInterrupt):
            certify(directory, replace(OPTIONS, episodes=121), make_env=make_env)
    assert Run(directory).find_checkpoint("certified") == before
    assert before.read_bytes() == content
    assert list(before.parent.iterdir()) == [before]
    for kind in ("best", "last"):
        (directory / "checkpoints" / kind / before.name).unlink(missing_ok=True)
    after = certify(directory, OPTIONS, make_env=make_env).checkpoint
    assert after.name != before.name
    assert list(after.parent.iterdir()) == [after]
    strict = CertificateOptions(ranking=6, episodes=12, tests=2, level=0.95, most_over=0.0)
    assert certify(directory, strict, make_env=make_env).checkpoint is None
    assert not json.loads((directory / "certificate.json").read_text())["certified"]
    with pytest.raises(FileNotFoundError):
        Run(directory).find_checkpoint("certified")


def test_without_limits_there_is_nothing_to_certify(train):
    directory = train("{}", "algo=ppo")
    assert certify(directory, OPTIONS, make_env=make_env) is None


def test_a_fixed_layout_is_certified_as_it_was_learned(train):
    met = []

    def make(node, *, seed, **keys):
        met.append(seed)
        return make_env(node, seed=seed, **keys)

    directory = train("{cost: 19}", "+env.randomize_layout=false", "seed=3")
    certify(directory, OPTIONS, make_env=make)
    assert set(met) == {3}
    # where layouts are drawn, neither training's nor the ranking's are tested
    met.clear()
    directory.joinpath("config.yaml").write_text(
        directory.joinpath("config.yaml").read_text().replace("randomize_layout: false", "")
    )
    certify(directory, OPTIONS, make_env=make)
    assert len(set(met)) == 2
    assert 3 not in met


def test_tests_of_a_seed_are_on_other_layouts_than_the_ranking_of_the_next(train):
    met = {}

    def make(node, *, seed, **keys):
        met[current].append(seed)
        return make_env(node, seed=seed, **keys)

    directory = train("{cost: 19}", "seed=0")
    config = (directory / "config.yaml").read_text()
    for current in range(3):
        met[current] = []
        (directory / "config.yaml").write_text(config.replace("seed: 0", f"seed: {current}"))
        certify(directory, OPTIONS, make_env=make)
    assert [len(set(seeds)) for seeds in met.values()] == [2, 2, 2]
    assert len({seed for seeds in met.values() for seed in seeds}) == 6


def test_policies_that_share_a_simulation_get_their_own_episodes(monkeypatch):
    def constant(trial, env):
        action = float(trial.checkpoint.name)
        return lambda state: state.set("action", torch.full((len(state), 2), action))

    monkeypatch.setattr(Trial, "policy", constant)
    config = point_mass_config("cost_limits={cost: 19}", "+env.physics=warp")
    options = EvaluationOptions(device="cpu", num_threads=1)
    trials = [Trial(config, Path(action), options, make_env) for action in ("-1", "0", "1")]
    _, together = next(_run(trials, _RANKING, 9, progress=False))
    for trial, found in zip(trials, together, strict=True):
        _, (alone,) = next(_run([trial], _RANKING, 9, progress=False))
        assert found.costs["cost"].shape == (9,)
        assert found.returns.mean().item() == pytest.approx(alone.returns.mean().item(), rel=0.1)
    assert len({found.returns.mean().round(decimals=1).item() for found in together}) == 3


def test_a_limit_on_the_costliest_episodes_is_certified_for_them(train):
    directory = train("{cost: 19}")
    certificate = certify(directory, replace(OPTIONS, tail=0.5), make_env=make_env)
    ((name, (_, most)),) = certificate.verdict.bounds.items()
    assert (name, most) == ("cvar_cost", 19.0)
    plain = certify(directory, OPTIONS, make_env=make_env).verdict
    assert certificate.verdict.means["cvar_cost"] > plain.means["mean_cost"]
    # the highest cost of an episode, not the highest value of the tested mean
    assert certificate.verdict.highest == plain.highest == {"cost": 20.0}


def test_what_an_episode_can_cost_is_known_from_the_environment():
    def highest(keys=(), **given):
        node = {"robot_base": "point", "num_steps": 30, "hazards_num": 1, "constrain_hazards": True}
        env = envs.make_env({**node, **dict(keys)}, num_envs=1, seed=0, **given)
        return env.highest_cost("cost")

    assert highest() == 30.0
    assert highest({"constrain_indicator": False}) == math.inf
    assert PointMass(2, 20).highest_cost("cost") == math.inf
    stop = {"_target_": "safe_rl.envs.transforms.EarlyTermination", "budgets": {"cost": 4.0}}
    assert highest(transforms={"stop": stop}, evaluating=True) == 30.0
    assert highest(transforms={"stop": {**stop, "in_evaluation": True}}, evaluating=True) == 5.0


@pytest.mark.parametrize(("level", "shown"), [(0.995, "99.5%"), (0.95, "95%"), (0.999, "99.9%")])
def test_levels_are_not_rounded(level, shown):
    certificate = Certificate(None, math.nan, Verdict(None, []), replace(OPTIONS, level=level))
    assert f"at {shown} with sampled actions: " in str(certificate)


def test_the_bounds_that_miss_their_limits_are_shown_with_the_limits():
    bounds, means = {"mean_cost": (10.82, 5.0), "mean_fast": (1.0, 2.0)}, {"mean_cost": 4.0}
    verdict = Verdict(None, [0], bounds, {"mean_cost": 5.82}, means, {}, 20)
    shown = str(Certificate(None, math.nan, verdict, OPTIONS))
    assert shown.endswith("(mean_cost ≤ 10.9, limit 5, mean 4; 20 new episodes).")


def test_costs_without_a_highest_are_said_to_count_up_to_a_cap_and_written_as_json(tmp_path):
    bounds = {"beyond_250_cost": (0.008, 0.01), "mean_cost": (math.inf, 25.0)}
    verdict = Verdict(0, [0], bounds, {}, {"mean_cost": 9.0}, {"cost": math.inf}, 700)
    certificate = Certificate(Path("checkpoint-000000000100.torchrl"), 1.0, verdict, OPTIONS)
    student = replace(certificate, options=replace(OPTIONS, bound="student"))
    for one in (certificate, student):
        assert "beyond a cap are not counted (beyond_250_cost: the share" in str(one)
    assert "assumes that no rare episodes cost far more" in str(student)

    def refuse(constant):
        raise AssertionError(f"{constant} is no JSON")

    _write(Run(tmp_path), certificate, [100])
    content = json.loads((tmp_path / "certificate.json").read_text(), parse_constant=refuse)
    assert content["bounds"]["mean_cost"] == {"bound": None, "most": 25.0}
    assert (content["episodes"], content["most_episodes"]) == (700, 120)
    assert read_certificate(content)["most_mean_cost"] == 25.0
