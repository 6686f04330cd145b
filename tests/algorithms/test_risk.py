"""Limits on tails: against their definitions, in closed form, and in runs of any algorithm."""

import pytest
import torch
from point_mass_runs import point_mass_trainer
from scipy.optimize import minimize_scalar
from scipy.stats import norm
from tensordict import TensorDict
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
from torch import nn
from torchrl.modules import IndependentNormal, ProbabilisticActor

from safe_rl.algorithms.constraints import PENALISED_COSTS
from safe_rl.collectors import EpisodeAccounting
from safe_rl.objectives import Chance, CostGAE, CVaR, TRPOLoss
from safe_rl.objectives.risk import cost_so_far
from safe_rl.runs.table import read_table


def cvar_of(limits, tail=0.25, window=10_000, ramp_start=0, ramp_steps=0):
    return CVaR(
        torch.tensor(limits), tail=tail, window=window,
        ramp_start=ramp_start, ramp_steps=ramp_steps,
    )  # fmt: skip


def random_episodes(rows=4, steps=60):
    """Costs [N, T, 2] and ends [N, T] of rows in which every episode is whole."""
    costs = torch.rand(rows, steps, 2) * torch.randint(0, 3, (rows, steps, 2))
    ends = torch.rand(rows, steps) < 0.2
    ends[:, -1] = True
    return costs, ends


def episodes_of(costs, ends):
    """Episode by episode, lists of step numbers: (row, first, last)."""
    for row in range(len(ends)):
        first = 0
        for last in ends[row].nonzero().flatten().tolist():
            yield row, first, last
            first = last + 1


def totals_of(costs, ends):
    return torch.stack(
        [costs[row, first : last + 1].sum(0) for row, first, last in episodes_of(costs, ends)]
    )


@pytest.mark.parametrize("tail", [0.1, 0.25, 0.6, 1.0])
def test_charges_of_cvar_solve_the_program_of_rockafellar_and_uryasev(tail):
    costs, ends = random_episodes()
    finished = totals_of(costs, ends)
    penalised = cvar_of([50.0, 50.0], tail)(costs, ends, torch.zeros(4, 2), finished)
    for i in range(2):
        worst = minimize_scalar(
            lambda nu, i=i: nu + (finished[:, i] - nu).clamp_min(0).mean().item() / tail,
            bounds=(0.0, float(finished[:, i].max()) + 1), method="bounded",
            options={"xatol": 1e-6},
        )  # fmt: skip
        measure = penalised.offset[i] + penalised.costs[..., i].sum() / len(finished)
        assert measure.item() == pytest.approx(worst.fun, rel=1e-4)


@pytest.mark.parametrize("kind", ["cvar", "chance"])
def test_batches_that_cut_episodes_charge_the_same(kind):
    costs, ends = random_episodes()
    finished = totals_of(costs, ends)
    before = torch.zeros(4, 2)

    def charge(steps):
        chance = Chance(torch.tensor([2.0, 3.0]), most_over=0.1)
        risk = cvar_of([2.0, 3.0]) if kind == "cvar" else chance
        spent = cost_so_far(costs, ends, before)
        parts = []
        for start in range(0, 60, steps):
            cut = slice(start, start + steps)
            open_costs = before
            if start:
                closed = ends[:, start - 1].unsqueeze(-1)
                open_costs = torch.where(closed, 0.0, spent[:, start - 1])
            parts.append(risk(costs[:, cut], ends[:, cut], open_costs, finished).costs)
        return torch.cat(parts, 1)

    # the same episodes are known to all of them, so that the value at risk is the same
    torch.testing.assert_close(charge(60), charge(7), atol=1e-4, rtol=1e-4)


def test_chance_charges_one_step_of_every_episode_over_the_limit():
    costs, ends = random_episodes()
    limits = torch.tensor([4.0, 0.0])
    penalised = Chance(limits, most_over=0.2)(costs, ends, torch.zeros(4, 2), torch.empty(0, 2))
    weight = limits.clamp_min(1)
    for row, first, last in episodes_of(costs, ends):
        spent = costs[row, first : last + 1].sum(0)
        of_episode = penalised.costs[row, first : last + 1]
        torch.testing.assert_close(of_episode.sum(0), torch.where(spent > limits, weight, 0.0))
        assert ((of_episode > 0).sum(0) <= 1).all()
    torch.testing.assert_close(penalised.limit, 0.2 * weight)


def test_the_tail_is_ramped_in():
    risk = cvar_of([5.0], tail=0.5, ramp_start=8, ramp_steps=8)
    costs, ends = torch.ones(1, 4, 1), torch.tensor([[False, False, False, True]])
    weights = []
    for _ in range(6):
        penalised = risk(costs, ends, torch.zeros(1, 1), torch.tensor([[4.0]]))
        weights.append(risk.weight)
        measure = penalised.costs.sum() + penalised.offset
        assert measure.item() == pytest.approx(4.0)  # the worst of equal episodes is the mean one
    assert weights == [0, 0, 0.5, 1, 1, 1]
    assert risk.schedule.startswith("Until step 8 the mean is limited; from step 16 on the CVaR")


def test_the_value_at_risk_is_that_of_the_last_episodes():
    risk, ends = cvar_of([5.0], tail=0.5, window=2), torch.zeros(1, 4, dtype=torch.bool)
    for finished in ([[9.0], [9.0]], [[1.0], [2.0]]):
        penalised = risk(torch.ones(1, 4, 1), ends, torch.zeros(1, 1), torch.tensor(finished))
    assert penalised.offset == 1


def test_the_accounting_knows_what_open_episodes_have_cost():
    costs, ends = random_episodes()
    accounting = EpisodeAccounting(4, ["a", "b"])
    spent = cost_so_far(costs, ends, torch.zeros(4, 2))
    for start in range(0, 60, 12):
        cut = slice(start, start + 12)
        following = {
            "a": costs[:, cut, :1], "b": costs[:, cut, 1:], "reward": torch.zeros(4, 12, 1),
            "done": ends[:, cut].unsqueeze(-1),
        }  # fmt: skip
        episodes = accounting.update(TensorDict({"next": following}, batch_size=[4, 12]))
        known = torch.stack([episodes.open_costs[key] for key in "ab"], -1)
        expected = torch.zeros(4, 2)
        if start:
            expected = torch.where(ends[:, start - 1].unsqueeze(-1), 0.0, spent[:, start - 1])
        torch.testing.assert_close(known.float(), expected, atol=1e-4, rtol=1e-4)


STEPS, EPISODES, TAIL = 5, 40_000, 0.25


def normal_actor():
    """One state, actions N(3, 0.3²)."""
    scale = AddStateIndependentNormalScale(1, init_value=-1.2)
    net = nn.Sequential(nn.Linear(1, 1), scale)
    nn.init.constant_(net[0].weight, 3.0)
    nn.init.zeros_(net[0].bias)
    return ProbabilisticActor(
        TensorDictModule(net, in_keys=["observation"], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=IndependentNormal,
        return_log_prob=True,
    )


def normal_costs(actor):
    """Episodes of STEPS steps that cost their actions, so that C is normal."""
    data = TensorDict(observation=torch.ones(EPISODES, STEPS, 1), batch_size=[EPISODES, STEPS])
    with torch.no_grad():
        actor(data.select("observation"))
        dist = actor.get_dist(data)
        data["action"] = dist.sample()
        data["action_log_prob"] = dist.log_prob(data["action"])
        data["loc"], data["scale"] = dist.base_dist.loc, dist.base_dist.scale
    done = torch.zeros(EPISODES, STEPS, 1, dtype=torch.bool)
    done[:, -1] = True
    # a constant value is a baseline, which leaves the expected gradient as it is
    zero = torch.zeros_like(data["action"])
    data["next"] = TensorDict(cost=data["action"], cost_value=zero, done=done, terminated=done)
    data["cost_value"] = zero
    return data


def slopes_of(risk, actor, data):
    """Gradient of the measure by the parameters, as an update sees it."""
    costs, ends = data["next", "cost"], data["next", "done"].squeeze(-1)
    finished = costs.sum(1)
    penalised = risk(costs, ends, torch.zeros(EPISODES, 1), finished)
    data["next", PENALISED_COSTS] = penalised.costs
    estimator = CostGAE([PENALISED_COSTS], None, gamma=1.0, lmbda=1.0, value_target="lambda_return")
    estimator(data)
    # a baseline that depends on time
    data["advantage"] = data["cost_advantage"] - data["cost_advantage"].mean(0)
    loss = TRPOLoss(actor, entropy_coeff=0.0)
    by_step = torch.autograd.grad(loss(data)["loss_objective"], list(actor.parameters()))
    gradient = dict(zip(("weight", "bias", "log_std"), by_step, strict=True))
    measure = penalised.offset + penalised.costs.sum() / EPISODES
    return measure.item(), {name: -STEPS * value.item() for name, value in gradient.items()}


def test_the_gradient_of_cvar_in_closed_form():
    """C is N(Tμ, Tσ²): CVaR = Tμ + √T σ φ(z) / α with z its (1 − α)-quantile."""
    actor = normal_actor()
    data = normal_costs(actor)
    sigma, z = data["scale"][0, 0].item(), norm.ppf(1 - TAIL)
    measure, slopes = slopes_of(cvar_of([1.0], TAIL, window=EPISODES), actor, data)
    spread = STEPS**0.5 * sigma
    assert measure == pytest.approx(3.0 * STEPS + spread * norm.pdf(z) / TAIL, rel=1e-3)
    assert slopes["bias"] == pytest.approx(STEPS, rel=0.05)
    assert slopes["log_std"] == pytest.approx(spread * norm.pdf(z) / TAIL, rel=0.05)


def test_the_gradient_of_a_chance_in_closed_form():
    """P(C > d) = 1 − Φ((d − Tμ) / √T σ); its derivatives are φ's."""
    actor = normal_actor()
    data = normal_costs(actor)
    spread = STEPS**0.5 * data["scale"][0, 0].item()
    limit = 3.0 * STEPS + 0.5 * spread
    measure, slopes = slopes_of(Chance(torch.tensor([limit]), most_over=0.1), actor, data)
    assert measure / limit == pytest.approx(1 - norm.cdf(0.5), abs=0.01)
    # steps before the last one can pass the limit only in sum: T dμ, and T σ² d(log σ)
    assert slopes["bias"] / limit == pytest.approx(norm.pdf(0.5) * STEPS / spread, rel=0.08)
    assert slopes["log_std"] / limit == pytest.approx(0.5 * norm.pdf(0.5), rel=0.15)


def train(directory, *overrides, **settings):
    """A run of a second on the point mass."""
    limits = "cost_limits={cost_hazards: 2, cost_north: 1}"
    trainer = point_mass_trainer(directory, limits, "frames=320", *overrides, **settings)
    trainer.run()
    return trainer, read_table(directory / "progress.csv")


@pytest.mark.parametrize(("algo", "risk"), [("ppo_lagrangian", "cvar"), ("cpo", "chance")])
def test_every_algorithm_takes_it(tmp_path, algo, risk):
    size = 40 if algo == "ppo_lagrangian" else None
    extra = ["risk.ramp_start=0", "risk.ramp_steps=0", "risk.tail=0.25", "limits.drift=null"]
    extra = extra if risk == "cvar" else []
    trainer, table = train(tmp_path, f"algo={algo}", f"risk={risk}", *extra, minibatch_size=size)
    assert trainer.algorithm.cost_advantage.reward_keys == [PENALISED_COSTS]
    for key, limit in (("cost_hazards", 2), ("cost_north", 1)):
        held = limit if risk == "cvar" else 0.1 * limit
        expected = [estimate - held for estimate in table[f"estimate_{key}"]]
        assert table[f"violation_{key}"] == pytest.approx(expected, abs=1e-5)
    pairs = zip(table["estimate_cost_hazards"], table["episode_cost_hazards"], strict=True)
    assert risk == "chance" or all(tail > mean for tail, mean in pairs if mean > 0)


def test_errors_of_a_controller_are_in_units_of_the_measures_limit(tmp_path):
    words = ["algo=ppo_lagrangian", "lagrangian=pid", "risk=chance"]
    algorithm = point_mass_trainer(tmp_path, *words, "cost_limits={cost_hazards: 2}").algorithm
    assert algorithm.multiplier.limits.tolist() == [*algorithm.constraints.measured_limits.values()]


def test_limits_of_whole_batches_take_no_tails(tmp_path):
    with pytest.raises(ValueError, match=r"^risk: .*limits=null"):
        train(tmp_path, "algo=ppo_lagrangian", "risk=cvar", "limits=null")


def test_a_resumed_run_charges_as_if_it_had_never_stopped():
    whole, second = (cvar_of([5.0], ramp_start=4, ramp_steps=100) for _ in range(2))
    batch = torch.rand(1, 8, 1), torch.zeros(1, 8, dtype=torch.bool), torch.rand(1, 1)
    whole(*batch, torch.rand(30, 1))
    second.load_state_dict(whole.state_dict())
    ours, theirs = (risk(*batch, torch.ones(1, 1)) for risk in (whole, second))
    assert all(torch.equal(one, other) for one, other in zip(ours, theirs, strict=True))
