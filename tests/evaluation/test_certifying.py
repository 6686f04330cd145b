"""The certificate of a run on the point mass, whose costs are known to be kept or broken."""

import json
import math
from dataclasses import replace

import pytest
import torch
from point_mass import PointMass
from run_configs import point_mass_config

from safe_rl import envs
from safe_rl.evaluation import Certificate, CertificateOptions, certify
from safe_rl.evaluation.certifying import _largest_cost, _write
from safe_rl.evaluation.loading import find_checkpoint
from safe_rl.reporting.recorded import read_certificate
from safe_rl.runs.folder import RunFolder
from safe_rl.scores.certificate import Verdict
from safe_rl.training.building import build_trainer, seed_everything

pytestmark = pytest.mark.long

OPTIONS = CertificateOptions(ranking=6, episodes=12, tests=2, level=0.95, most_over=1.0)


def make_env(node, *, num_envs, device, seed, num_threads):
    return PointMass(num_envs, 20, seed % 1000)


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
    directory = train("{cost: 1000}")
    certificate = certify(directory, OPTIONS, make_env=make_env)
    written = json.loads((directory / "certificate.json").read_text())
    assert written["certified"]
    assert written["bounds"]["mean_cost"]["bound"] < written["bounds"]["mean_cost"]["most"] == 1000
    # the last two epochs, and the best three: several files may be of the same epoch
    assert len(written["candidates"]) == len(set(written["candidates"])) >= 2
    assert find_checkpoint(directory, "certified") == certificate.checkpoint
    assert certificate.checkpoint.read_bytes()
    assert str(certificate).startswith("Certified at 95%: mean_cost ≤ ")


def test_none_is_certified_where_limits_are_broken_and_it_says_by_how_much(train):
    directory = train("{cost_hazards: 0.01}")
    certificate = certify(directory, OPTIONS, make_env=make_env)
    assert certificate.checkpoint is None
    assert certificate.verdict.shortfalls["mean_cost_hazards"] > 0.1
    assert len(certificate.verdict.tested) == 2
    assert "mean_cost_hazards by" in str(certificate)
    with pytest.raises(FileNotFoundError, match="none of its policies has been certified"):
        find_checkpoint(directory, "certified")


def test_a_certificate_is_taken_back_with_its_policy(train):
    directory = train("{cost: 1000}")
    certify(directory, OPTIONS, make_env=make_env)
    strict = CertificateOptions(ranking=6, episodes=12, tests=2, level=0.95, most_over=0.0)
    assert certify(directory, strict, make_env=make_env).checkpoint is None
    assert not json.loads((directory / "certificate.json").read_text())["certified"]
    with pytest.raises(FileNotFoundError):
        find_checkpoint(directory, "certified")


def test_an_interrupted_certificate_leaves_the_policy_of_before(train, monkeypatch):
    directory = train("{cost: 1000}")
    before = certify(directory, OPTIONS, make_env=make_env).checkpoint
    content = before.read_bytes()

    def interrupt(source, target):
        target = target / source.name if target.is_dir() else target
        target.write_bytes(source.read_bytes()[:100])
        raise KeyboardInterrupt

    monkeypatch.setattr("shutil.copy2", interrupt)
    with pytest.raises(KeyboardInterrupt):
        certify(directory, replace(OPTIONS, episodes=13), make_env=make_env)
    assert find_checkpoint(directory, "certified") == before
    assert before.read_bytes() == content
    assert list(before.parent.iterdir()) == [before]


def test_a_new_certificate_takes_the_place_of_the_one_before(train):
    directory = train("{cost: 1000}")
    before = certify(directory, OPTIONS, make_env=make_env).checkpoint
    others = {path for kind in ("best", "last")
              for path in (directory / "checkpoints" / kind).glob("*.torchrl")}  # fmt: skip
    for path in others:
        if path.name == before.name:
            path.unlink()
    after = certify(directory, OPTIONS, make_env=make_env).checkpoint
    assert after.name != before.name
    assert list(after.parent.iterdir()) == [after]


def test_the_same_run_gets_the_same_certificate(train):
    directory = train("{cost: 1000}")
    first = certify(directory, OPTIONS, make_env=make_env)
    torch.rand(3)
    assert certify(directory, OPTIONS, make_env=make_env) == first


def test_without_limits_there_is_nothing_to_certify(train):
    directory = train("{}", "algo=ppo")
    assert certify(directory, OPTIONS, make_env=make_env) is None


def test_a_fixed_layout_is_certified_as_it_was_learned(train):
    met = []

    def make(node, *, seed, **keys):
        met.append(seed)
        return make_env(node, seed=seed, **keys)

    directory = train("{cost: 1000}", "+env.randomize_layout=false", "seed=3")
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


def test_the_second_test_of_the_nearest_is_on_more_episodes_of_other_worlds(train):
    met = []

    def make(node, *, num_envs, seed, **keys):
        met.append((num_envs, seed))
        return make_env(node, num_envs=num_envs, seed=seed, **keys)

    directory = train("{cost: 1000}")
    once = replace(OPTIONS, tests=1, retest=3)
    bound = certify(directory, once, make_env=make).verdict.bounds["mean_cost"][0]
    config = directory / "config.yaml"
    config.write_text(config.read_text().replace("cost: 1000", f"cost: {bound - 1e-3}"))
    met.clear()
    certificate = certify(directory, once, make_env=make)
    first, again = certificate.verdict.tested
    assert first == again
    (*_, tested, retested) = met
    assert [num_envs for num_envs, _ in (tested, retested)] == [12, 36]
    assert len({seed for _, seed in met}) == 3
    assert certificate.verdict.bounds["mean_cost"][0] != bound


def test_what_an_episode_can_cost_is_known_from_the_environment():
    def largest(name, **keys):
        return _largest_cost(envs.make_env({**name, **keys}, num_envs=1, seed=0), "cost")

    point = {"robot_base": "point", "num_steps": 30, "hazards_num": 1, "constrain_hazards": True}
    assert largest(point) == 30.0
    assert largest(point, constrain_indicator=False) == math.inf
    assert _largest_cost(PointMass(2, 20), "cost") == math.inf


@pytest.mark.parametrize(("level", "shown"), [(0.995, "99.5%"), (0.95, "95%"), (0.999, "99.9%")])
def test_levels_are_not_rounded(level, shown):
    certificate = Certificate(None, math.nan, Verdict(None, []), replace(OPTIONS, level=level))
    assert f"at {shown}: " in str(certificate)


def test_a_certificate_that_says_why_a_limit_of_nothing_is_not_kept():
    verdict = Verdict(None, [0], {"mean_cost": (4.0, 0.0)}, {"mean_cost": 4.0}, ["cost"])
    line = str(Certificate(None, math.nan, verdict, OPTIONS))
    assert "by 4). All tested episodes had the same cost: the bound is what unseen ones" in line
    verdict = Verdict(None, [0], {"mean_cost": (4.0, 0.0)}, {"mean_cost": 4.0})
    assert str(Certificate(None, math.nan, verdict, OPTIONS)).endswith("(mean_cost by 4).")


def test_a_cost_without_a_largest_is_said_in_words_and_written_as_json(tmp_path):
    verdict = Verdict(None, [0], {"mean_cost": (math.inf, 25.0)}, {"mean_cost": math.inf}, ["cost"])
    certificate = Certificate(None, math.nan, verdict, OPTIONS)
    assert "the environment's spec does not say" in str(certificate)
    assert "env.constrain_indicator=true" in str(certificate)

    def refuse(constant):
        raise AssertionError(f"{constant} is no JSON")

    _write(RunFolder(tmp_path), certificate, [100])
    content = json.loads((tmp_path / "certificate.json").read_text(), parse_constant=refuse)
    assert content["bounds"] == {"mean_cost": {"bound": None, "most": 25.0}}
    assert read_certificate(content)["bounds"]["mean_cost"][1] == 25.0
