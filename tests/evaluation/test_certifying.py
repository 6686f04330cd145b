"""The certificate of a run on the point mass, whose costs are known to be kept or broken."""

import json
import re
import shutil
from dataclasses import replace
from functools import cache
from unittest.mock import Mock

import pytest
import torch
from point_mass import PointMass, PricedPointMass
from run_configs import point_mass_config

from safe_rl.evaluation import Certificate, CertificateOptions, certify, certifying
from safe_rl.evaluation.certifying import _TEST
from safe_rl.evaluation.policies import pack_policy
from safe_rl.runs.run import Run
from safe_rl.scores.certificate import Claim, Verdict
from safe_rl.training.building import build_trainer, seed_everything

pytestmark = pytest.mark.long

OPTIONS = CertificateOptions(ranking=6, episodes=120, tests=2, level=0.95, most_over=1.0)


def make_env(node, *, num_envs, device, seed, num_threads):
    return PricedPointMass(num_envs, 20, seed % 1000)


def change(directory, before, after):
    """Replace words of a run's configuration."""
    path = directory / "config.yaml"
    path.write_text(path.read_text().replace(before, after))


def certify_noting_seeds(directory, options=OPTIONS):
    """The certificate, and the seeds of the environments whose episodes it is made of."""
    make = Mock(wraps=make_env)
    certificate = certify(directory, options, make_env=make)
    return certificate, {call.kwargs["seed"] for call in make.call_args_list}


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    @cache
    def trained(limits, *overrides):
        config = point_mass_config(f"cost_limits={limits}", "checkpoint.interval=0", *overrides)
        seed_everything(config.seed, None)
        env = PointMass(config.num_envs, 20, config.seed)
        build_trainer(config, env, folder := tmp_path_factory.mktemp("trained")).run()
        return folder

    return trained


@pytest.fixture
def train(trained, tmp_path):
    """Trains a run, or copies the one that was trained so."""
    return lambda *words: shutil.copytree(trained(*words), tmp_path / "run")


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
    assert re.match(
        r"Certified at 95% with sampled actions: mean_cost ≤ [\d.]+, limit 19 "
        r"\(1\d\d new episodes\), mean [\d.]+ in 100 further episodes, at [\d,]+ steps, return ",
        str(certificate),
    )
    assert "The bound includes rare episodes that cost up to 20." in str(certificate)
    torch.rand(3)
    assert certify(directory, OPTIONS, make_env=make_env) == certificate
    second = certify(directory, replace(OPTIONS, episodes=130), make_env=make_env)
    assert "test 2 of this run; the level is that of all its tests" in str(second)


def test_a_certificate_is_about_the_policy_beside_it_whenever_it_is_interrupted(train, monkeypatch):
    directory = train("{cost: 19}")
    run = Run(directory)
    first = certify(directory, OPTIONS, make_env=make_env).checkpoint
    other = next(path for path in run.checkpoints("last") if path.name != first.name)

    def certify_other():
        certificate = Certificate(other, 1.0, Verdict(0, [0], {}, {}, [], {}, 9), OPTIONS)
        certifying._keep(run, other)
        certifying._write(run, certificate, [0])
        certifying._remove_earlier(run, other)

    for step in ("_write", "_remove_earlier"):
        with monkeypatch.context() as patch:
            patch.setattr(certifying, step, Mock(side_effect=KeyboardInterrupt))
            with pytest.raises(KeyboardInterrupt):
                certify_other()
        name = run.certificate["checkpoint"]
        assert run.find_checkpoint("certified").name == name
    assert (first.name, other.name) == (first.name, name)
    # another policy under the certified name, in the folder or as a file that is named
    shutil.copy(run.checkpoints("last")[0], run.find_checkpoint("certified"))
    shutil.copy(first, run.checkpoints_folder / "certified" / other.name)
    with pytest.raises(ValueError, match="is not the policy that certificate"):
        run.find_checkpoint("certified")
    assert run.certificate_of(run.checkpoints_folder / "certified" / other.name) is None
    with pytest.raises(ValueError, match="is not the policy that certificate"):
        pack_policy(directory, directory.parent / "exported")


def test_tests_of_a_run_spend_its_error_once_each(train):
    directory = train("{cost: 19}")
    longer = [replace(OPTIONS, episodes=120 + 100 * k) for k in range(3)]
    made = [certify(directory, each, make_env=make_env) for each in (*longer, longer[0])]
    tests = json.loads((directory / "certificate_tests.json").read_text())
    errors = [test["error"] for test in tests]
    assert errors == pytest.approx([0.0375, 0.009375, 0.00234375])
    levels = [Claim({"cost": 19.0}, level=1 - e, highest={"cost": 20.0}) for e in errors]
    assert [one.fewest for one in made] == [level.fewest(2) for level in (*levels, levels[0])]
    assert json.loads((directory / "certificate.json").read_text())["test"] == 1
    strict = replace(OPTIONS, level=0.99)
    with pytest.raises(ValueError, match=r"have spent an error of 0\.0492"):
        certify(directory, strict, make_env=make_env)
    (directory / "certificate_tests.json").write_text('[{"level": 0.95}]')
    with pytest.raises(ValueError, match=r"certificate_tests\.json is not as a run writes it"):
        certify(directory, strict, make_env=make_env)


@pytest.mark.parametrize(
    ("limit", "why"),
    [("19", "2 episodes never suffice: at least "), ("0", "no number of episodes can show this")],
)
def test_a_test_that_cannot_succeed_is_not_made_and_changes_nothing(train, limit, why):
    directory = train("{cost: 19}")
    assert certify(directory, OPTIONS, make_env=make_env).checkpoint is not None
    if limit == "0":
        change(directory, "cost: 19", "cost: 0")
    files = {path: path.read_bytes() for path in directory.rglob("*") if path.is_file()}
    refused = certify(directory, replace(OPTIONS, episodes=2), make_env=make_env)
    assert str(refused).startswith(f"Not tested at 95% with sampled actions: {why}")
    assert not refused.may_need_training
    assert files == {path: path.read_bytes() for path in directory.rglob("*") if path.is_file()}


def test_the_mean_beside_a_bound_is_of_episodes_that_did_not_end_the_test(train, monkeypatch):
    met = []

    def watch(*arguments):
        for highest, found in run(*arguments):
            met.append((arguments[1], found[0].costs["cost"]))
            yield highest, found

    run = certifying._run
    monkeypatch.setattr(certifying, "_run", watch)
    certificate = certify(train("{cost: 19}"), OPTIONS, make_env=make_env)
    purpose, costs = met[-1]
    assert purpose not in [other for other, _ in met[:-1]]
    assert (certificate.means, certificate.further) == ({"mean_cost": costs.mean().item()}, 100)


def test_mean_actions_are_certified_as_such(train):
    directory = train("{cost: 19}")
    sampled = certify(directory, OPTIONS, make_env=make_env)
    assert not json.loads((directory / "certificate.json").read_text())["deterministic"]
    mean = certify(directory, replace(OPTIONS, deterministic=True), make_env=make_env)
    assert json.loads((directory / "certificate.json").read_text())["deterministic"]
    assert "Certified at 95% with mean actions: " in str(mean)
    assert mean.episode_return != sampled.episode_return


def test_none_is_certified_where_limits_are_broken_and_it_says_by_how_much(train):
    directory = train("{cost_hazards: 2}")
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
    third = certify(directory, OPTIONS, make_env=make_env)
    after = third.checkpoint
    assert third.test == 3  # as of other checkpoints
    assert after.name != before.name
    assert list(after.parent.iterdir()) == [after]
    change(directory, "cost: 19", "cost: 2")
    assert certify(directory, OPTIONS, make_env=make_env).checkpoint is None
    assert not json.loads((directory / "certificate.json").read_text())["certified"]
    with pytest.raises(FileNotFoundError):
        Run(directory).find_checkpoint("certified")


def test_an_exported_policy_is_certified_anew_and_keeps_its_weights(train, tmp_path):
    run, folder = train("{cost: 19}"), tmp_path / "policy"
    certify(run, OPTIONS, make_env=make_env)
    weights = pack_policy(run, folder)
    mean = certify(folder, replace(OPTIONS, deterministic=True), make_env=make_env)
    assert mean.checkpoint == weights
    change(folder, "cost: 19", "cost: 2")
    assert certify(folder, OPTIONS, make_env=make_env).checkpoint is None
    assert Run(folder).find_checkpoint("last").name == weights.name
    with pytest.raises(FileNotFoundError):
        Run(folder).find_checkpoint("certified")


def test_one_candidate_has_the_error_of_a_test_alone_and_episodes_that_have_not_chosen_it(
    train, tmp_path
):
    run, fewest, seeds = train("{cost: 19}"), [], {}
    for place, tests in (("run", 1), ("alone", 1), ("of three", 3), ("run again", 2)):
        folder = run if place.startswith("run") else pack_policy(run, tmp_path / place).parents[2]
        certificate, met = certify_noting_seeds(folder, replace(OPTIONS, tests=tests))
        fewest.append(certificate.fewest)
        seeds[place] = {seed for seed in met if seed > _TEST}
    assert fewest[0] == fewest[1] == fewest[2]
    assert seeds["alone"] == seeds["of three"]
    assert not seeds["run"] & seeds["alone"]
    assert not seeds["run"] & seeds["run again"]


def test_a_device_that_this_machine_lacks_is_replaced(train, monkeypatch):
    directory, make = train("{cost: 19}"), Mock(side_effect=KeyboardInterrupt)
    change(directory, "device: cpu", "device: cuda:1")
    for name, value in (("is_available", True), ("device_count", 1)):
        monkeypatch.setattr(torch.cuda, name, lambda value=value: value)
    with pytest.raises(KeyboardInterrupt):
        certify(directory, OPTIONS, make_env=make)
    assert make.call_args.kwargs["device"] == "cuda"


def test_without_limits_there_is_nothing_to_certify(train):
    directory = train("{}", "algo=ppo", "frames=160")
    assert certify(directory, OPTIONS, make_env=make_env) is None


def test_a_fixed_layout_is_certified_as_it_was_learned(train):
    directory = train("{cost: 19}", "+env.randomize_layout=false", "seed=3")
    assert certify_noting_seeds(directory)[1] == {3}
    # where layouts are drawn, neither training's nor the ranking's are tested
    change(directory, "randomize_layout: false", "")
    _, seeds = certify_noting_seeds(directory)
    assert len(seeds) > 2
    assert 3 not in seeds


def test_tests_of_a_seed_are_on_other_layouts_than_the_ranking_of_the_next(train):
    directory, different = train("{cost: 19}", "seed=0"), []
    for seed in range(3):
        change(directory, f"seed: {seed - 1}", f"seed: {seed}")
        different.append(certify_noting_seeds(directory)[1])
    assert len(set.union(*different)) == sum(map(len, different))


def test_a_limit_on_the_costliest_episodes_is_certified_for_them(train):
    directory = train("{cost: 19}")
    shares = {"tail": 0.5, "most_over": 0.9, "cap": 19.5, "most_beyond": 0.2}
    certificate = certify(directory, replace(OPTIONS, **shares), make_env=make_env)
    limits = {name: most for name, (_, most) in certificate.verdict.bounds.items()}
    assert limits == {"beyond_19.5_cost": 0.2, "cvar_cost": 19.0, "over_limit_cost": 0.9}
    plain = certify(directory, OPTIONS, make_env=make_env)
    assert certificate.means["cvar_cost"] > plain.means["mean_cost"]
    # the highest cost of an episode, not the highest value of the tested mean
    assert certificate.verdict.highest == plain.verdict.highest == {"cost": 20.0}
