"""Limits on tails: against their definitions, in closed form, and in runs of any algorithm."""

from types import SimpleNamespace

import pytest
import torch
from point_mass_runs import point_mass_trainer, trainer_of
from run_configs import off_policy_config, point_mass_config
from scipy.optimize import minimize_scalar
from tensordict import TensorDict

from safe_rl.algorithms.constraints import Constraints
from safe_rl.collectors import EpisodeAccounting
from safe_rl.objectives import Chance, CVaR
from safe_rl.objectives.risk import MeasuredCosts, RiskMeasure
from safe_rl.runs.table import read_table
from safe_rl.trust import allow


def cvar_of(limits, tail=0.25, window=10_000):
    return CVaR(torch.tensor(limits), tail=tail, window=window)


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
def test_measured_costs_of_cvar_solve_the_program_of_rockafellar_and_uryasev(tail):
    costs, ends = random_episodes()
    finished = totals_of(costs, ends)
    measured = cvar_of([50.0, 50.0], tail)(costs, ends, torch.zeros(4, 2), finished)
    for i in range(2):
        worst = minimize_scalar(
            lambda nu, i=i: nu + (finished[:, i] - nu).clamp_min(0).mean().item() / tail,
            bounds=(0.0, float(finished[:, i].max()) + 1), method="bounded",
            options={"xatol": 1e-6},
        )  # fmt: skip
        measure = measured.offset[i] + measured.costs[..., i].sum() / len(finished)
        assert measure.item() == pytest.approx(worst.fun, rel=1e-4)


@pytest.mark.parametrize("kind", ["cvar", "chance"])
def test_batches_that_cut_episodes_charge_the_same(kind):
    """The accounting knows what open episodes have cost."""
    costs, ends = random_episodes()
    finished = totals_of(costs, ends)

    def charge(steps):
        chance = Chance(torch.tensor([2.0, 3.0]), most_over=0.1)
        risk = cvar_of([2.0, 3.0]) if kind == "cvar" else chance
        accounting, parts = EpisodeAccounting(4, ["a", "b"]), []
        for cost, end in zip(costs.split(steps, 1), ends.split(steps, 1), strict=True):
            following = {"a": cost[..., :1], "b": cost[..., 1:], "done": end.unsqueeze(-1)}
            following["reward"] = torch.zeros_like(cost[..., :1])
            episodes = accounting.update(TensorDict(next=following, batch_size=end.shape))
            before = torch.stack([episodes.open_costs[key] for key in "ab"], -1).float()
            parts.append(risk(cost, end, before, finished).costs)
        return torch.cat(parts, 1)

    # the same episodes are known to all of them, so that the value at risk is the same
    torch.testing.assert_close(charge(60), charge(7), atol=1e-4, rtol=1e-4)


def test_chance_charges_one_step_of_every_episode_over_the_limit():
    costs, ends = random_episodes()
    limits = torch.tensor([4.0, 0.0])
    measured = Chance(limits, most_over=0.2)(costs, ends, torch.zeros(4, 2), torch.empty(0, 2))
    weight = limits.clamp_min(1)
    for row, first, last in episodes_of(costs, ends):
        spent = costs[row, first : last + 1].sum(0)
        of_episode = measured.costs[row, first : last + 1]
        torch.testing.assert_close(of_episode.sum(0), torch.where(spent > limits, weight, 0.0))
        assert ((of_episode > 0).sum(0) <= 1).all()
    torch.testing.assert_close(measured.limit, 0.2 * weight)


def test_until_an_episode_has_finished_the_mean_is_measured():
    risk, ends = cvar_of([5.0], tail=0.5), torch.zeros(1, 4, dtype=torch.bool)
    measured = risk(torch.ones(1, 4, 1), ends, torch.zeros(1, 1), torch.empty(0, 1))
    assert measured.costs.sum() + measured.offset == 4.0


def test_the_value_at_risk_is_that_of_the_last_episodes():
    risk, ends = cvar_of([5.0], tail=0.5, window=2), torch.zeros(1, 4, dtype=torch.bool)
    for finished in ([[9.0], [9.0]], [[1.0], [2.0]]):
        measured = risk(torch.ones(1, 4, 1), ends, torch.zeros(1, 1), torch.tensor(finished))
    assert measured.offset == 1


LIMITS = "cost_limits={cost_hazards: 2, cost_north: 1}"


@pytest.mark.parametrize(
    ("algo", "risk"),
    [("ppo_lagrangian", "cvar"), ("cpo", "chance"), ("sac_lagrangian", "cvar")],
)
def test_every_algorithm_takes_it(tmp_path, algo, risk):
    words = [f"algo={algo}", f"risk={risk}", LIMITS, "frames=320", "limits.margin=0"]
    words += ["risk.tail=0.25", "limits.drift=null"] if risk == "cvar" else []
    if algo == "sac_lagrangian":
        trainer = trainer_of(off_policy_config(*words), tmp_path)
    else:
        size = 40 if algo == "ppo_lagrangian" else None
        trainer = point_mass_trainer(tmp_path, *words, minibatch_size=size)
    trainer.run()
    table = read_table(tmp_path / "progress.csv")
    for key, limit in (("cost_hazards", 2), ("cost_north", 1)):
        held = limit if risk == "cvar" else 0.1 * limit
        expected = [estimate - held for estimate in table[f"estimate_{key}"]]
        assert table[f"violation_{key}"] == pytest.approx(expected, abs=1e-5)
        # where the descent has ended, it is the measure's limit that policies are held to
        assert table[f"target_{key}"][-1] == pytest.approx(held)
        # surrogates predict the mean cost: the change of another measure says nothing about them
        assert algo != "cpo" or table[f"trust_{key}"] == [1.0] * len(expected)
    pairs = zip(table["estimate_cost_hazards"], table["episode_cost_hazards"], strict=True)
    assert risk == "chance" or all(tail > mean for tail, mean in pairs if mean > 0)


class OfYourOwn(RiskMeasure):
    def __init__(self, cost_limits, *, max_length, steps_per_decision, share):
        self.limits, self.given = share * cost_limits, (max_length, steps_per_decision)

    def __call__(self, costs, ends, before, finished):
        return MeasuredCosts(costs, torch.zeros_like(self.limits), self.limits)


def test_a_measure_of_your_own_knows_the_length_of_episodes_in_decisions():
    config = point_mass_config("algo=ppo_lagrangian", LIMITS)
    config.risk = {"_target_": f"{__name__}.OfYourOwn", "share": 0.5}
    env = SimpleNamespace(max_episode_steps=22, steps_per_decision=4)
    allow(__name__)
    constraints = Constraints.from_config(config, env)
    assert constraints.risk.given == (6, 4)
    assert constraints.measured_limits == {"cost_hazards": 1.0, "cost_north": 0.5}


def test_errors_of_a_controller_are_in_units_of_the_measures_limit(tmp_path):
    words = ["algo=ppo_lagrangian", "lagrangian=pid", "risk=chance"]
    algorithm = point_mass_trainer(tmp_path, *words, "cost_limits={cost_hazards: 2}").algorithm
    assert algorithm.multiplier.limits.tolist() == [*algorithm.constraints.measured_limits.values()]


def test_limits_of_whole_batches_take_no_tails(tmp_path):
    with pytest.raises(ValueError, match=r"^risk: .*limits=null"):
        point_mass_trainer(tmp_path, "algo=ppo_lagrangian", "risk=cvar", LIMITS, "limits=null")


def test_a_resumed_run_charges_as_if_it_had_never_stopped():
    whole, second = (cvar_of([5.0]) for _ in range(2))
    batch = torch.rand(1, 8, 1), torch.zeros(1, 8, dtype=torch.bool), torch.rand(1, 1)
    whole(*batch, torch.rand(30, 1))
    second.load_state_dict(whole.state_dict())
    ours, theirs = (risk(*batch, torch.ones(1, 1)) for risk in (whole, second))
    assert all(torch.equal(one, other) for one, other in zip(ours, theirs, strict=True))
