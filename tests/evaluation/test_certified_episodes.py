"""The episodes of which a certificate is made: new ones, shared out among the candidates."""

import math
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from point_mass import PointMass, PricedPointMass
from run_configs import point_mass_config

from safe_rl import envs
from safe_rl.evaluation import CertificateOptions, certifying
from safe_rl.evaluation.certifying import _RANKING, _TEST, _run
from safe_rl.evaluation.episodes import Episodes
from safe_rl.evaluation.measuring import PolicyEvaluation
from safe_rl.evaluation.settings import EvaluationOptions
from safe_rl.scores.certificate import Claim

pytestmark = pytest.mark.long


def make_env(node, *, num_envs, device, seed, num_threads):
    return PricedPointMass(num_envs, 20, seed % 1000)


def test_every_batch_of_a_test_has_new_instances_of_the_environment():
    """An instance draws at construction what its episodes cost: they are not independent."""

    class Drawn(PricedPointMass):
        def __init__(self, *arguments):
            super().__init__(*arguments)
            generator = torch.Generator().manual_seed(arguments[2])
            self.drawn = (torch.rand(*self.batch_size, 1, generator=generator) < 0.1).float()

        def _step(self, tensordict):
            return super()._step(tensordict).set("cost", self.drawn)

    def make(node, *, num_envs, device, seed, num_threads):
        return Drawn(num_envs, 20, seed % 2**31)

    config = point_mass_config("cost_limits={cost: 19}")
    options = EvaluationOptions(device="cpu", num_threads=1)
    evaluation = PolicyEvaluation(config, Path("0"), options, make)
    evaluation.__dict__["policy"] = lambda env: (
        lambda state: state.set("action", torch.zeros(len(state), 2))
    )
    costs = torch.stack(
        [found[0].costs["cost"] for _, found in _run([evaluation], _TEST, 2000, 100, False)]
    )
    assert costs.shape == (20, 100)
    # of rows that cost 20 in one batch, a tenth does in the next, and not all
    again = costs[1:][costs[:-1] > 0]
    assert again.mean().item() == pytest.approx(2.0, abs=1.5)


def test_on_a_fixed_layout_the_test_has_other_episodes_than_the_ranking(monkeypatch):
    layouts = []

    def still(evaluation, env):
        env.reset()
        layouts.append(env.get_state()["layout"])
        return lambda state: state.set("action", torch.zeros(len(state), 2))

    def make(node, **keys):
        noisy = {"num_steps": 5, "randomize_layout": False, "action_noise": 0.5}
        return envs.make_env("PointGoal1", **noisy, **keys)

    monkeypatch.setattr(PolicyEvaluation, "policy", still)
    config = point_mass_config("cost_limits={cost: 19}", "+env.randomize_layout=false")
    evaluation = PolicyEvaluation(config, Path("0"), EvaluationOptions(num_threads=1), make)
    ranked, tested = (next(_run([evaluation], use, 4, 4, False))[1][0] for use in (_RANKING, _TEST))
    assert (ranked.returns != tested.returns).all()
    torch.testing.assert_close(*layouts)


def test_the_ranking_gives_up_the_worse_half_in_every_round(monkeypatch):
    """Sixteen candidates; the higher their number, the more they cost, all above the limit."""
    used = dict.fromkeys(range(16), 0)

    def run(evaluations, seed, number, batch, progress):
        (evaluation,) = evaluations
        assert batch == number
        used[evaluation.number] += number
        costs = 20.0 + evaluation.number + torch.rand(number) / 10
        yield {"cost": 100.0}, [Episodes(costs, costs, {"cost": costs})]

    monkeypatch.setattr(certifying, "_run", run)
    evaluations = [SimpleNamespace(node={}, number=number) for number in used]
    claim = Claim({"cost": 19.0})
    options = CertificateOptions(ranking=40, episodes=120, tests=2, level=0.95, most_over=1.0)
    order, claims = certifying._ranked(evaluations, claim, options, False)
    assert order == list(range(16))
    assert [used[number] for number in order] == [40] * 4 + [20] * 4 + [10] * 8
    assert {one.highest["cost"] for one in claims} == {100.0}


def test_policies_that_share_a_simulation_get_their_own_episodes(monkeypatch):
    def constant(evaluation, env):
        action = float(evaluation.checkpoint.name)
        return lambda state: state.set("action", torch.full((len(state), 2), action))

    monkeypatch.setattr(PolicyEvaluation, "policy", constant)
    config = point_mass_config("cost_limits={cost: 19}", "+env.physics=warp")
    options = EvaluationOptions(device="cpu", num_threads=1)
    evaluations = [
        PolicyEvaluation(config, Path(action), options, make_env) for action in ("-1", "0", "1")
    ]
    _, together = next(_run(evaluations, _RANKING, 9, 9, progress=False))
    for evaluation, found in zip(evaluations, together, strict=True):
        _, (alone,) = next(_run([evaluation], _RANKING, 9, 9, progress=False))
        assert found.costs["cost"].shape == (9,)
        assert found.returns.mean().item() == pytest.approx(alone.returns.mean().item(), rel=0.1)
    assert len({found.returns.mean().round(decimals=1).item() for found in together}) == 3


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
    ends = {"stop": {**stop, "in_evaluation": True}}
    assert highest(transforms=ends, evaluating=True) == 5.0
    held = {"hold": {"_target_": "safe_rl.envs.transforms.ActionRepeat", "k": 4}}
    assert highest(transforms=ends | held, evaluating=True) == 5.0
