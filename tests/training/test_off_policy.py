"""Runs with a replay buffer: they learn, resume, start from one another and are evaluated."""

import math
from functools import partial

import pytest
import torch
from point_mass import Forgetful, PointMass
from point_mass_runs import trainer_of
from run_configs import assert_resumes_exactly, compose_config, off_policy_config
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import RandomPolicy

from safe_rl.algorithms import OffPolicy
from safe_rl.collectors import EpisodeError
from safe_rl.evaluation.episodes import collect_episodes, periodic_evaluation
from safe_rl.evaluation.loading import load_policy
from safe_rl.objectives import SACLagrangianLoss
from safe_rl.runs.run import Run
from safe_rl.runs.table import read_table
from safe_rl.training.building import begin_from
from safe_rl.trust import allow

pytestmark = pytest.mark.long


@pytest.fixture
def make_trainer(tmp_path):
    return lambda name, *words: trainer_of(off_policy_config(*words), tmp_path / name)


def finished(trainer):
    """The table of a run, at its end."""
    trainer.run()
    return read_table(trainer.writer.run.table_file)


@pytest.mark.parametrize(
    "overrides",
    [
        ["algo=td3_lagrangian", "memory.n_steps=3", "lagrangian=adam"],
        ["algo=sac_lagrangian", "memory.capacity=300", "limits=null"],
        ["algo=wcsac", "risk.window=9", "policy_update.updates_per_step=0.021"],  # 3.36 an epoch
        ["algo=cal", "cost_limits={cost_hazards: 1, cost_north: 2}", "lagrangian=pid"],
    ],
)
def test_it_resumes_with_its_replay_buffer_as_if_it_had_never_stopped(
    overrides, make_trainer, tmp_path
):
    half = [] if "limits=null" in overrides else ["limits.frames=1280"]
    make = lambda name, *first: make_trainer(name, *first, *overrides)  # noqa: E731
    resumed = assert_resumes_exactly(make, tmp_path, "frames=640", *half)
    assert resumed.algorithm.lost_on_resume == ""


def test_without_its_replay_buffer_it_says_so_and_fills_a_new_one(make_trainer):
    forgetful = ["algo=sac_lagrangian", "memory.keep=false"]
    make_trainer("run", *forgetful, "frames=640", "exploration.random_steps=200").run()
    resumed = make_trainer("run", *forgetful, "exploration.random_steps=200")
    assert resumed.resume()
    assert "memory.keep=false" in resumed.algorithm.lost_on_resume
    assert "200" in resumed.algorithm.lost_on_resume
    # it acts as it has learned at once, but learns when there is enough to learn from
    assert not resumed.algorithm.policy.is_random
    table = finished(resumed)
    assert table["policy_num_updates"] == [0, 8, 8, 8, 0, 8, 8, 8]
    learned = [not math.isnan(loss) for loss in table["policy_loss_qvalue"]]
    assert learned == [False, True, True, True, False, True, True, True]


def test_a_run_that_ends_before_it_learns_says_so(make_trainer):
    short = ["algo=sac", "memory.keep=false", "exploration.random_steps=321"]
    first = make_trainer("run", *short, "frames=160")
    said = "Nothing will be learned: the run has 160 steps, and learning begins after 321 "
    assert first.algorithm.learns_from.startswith(said)
    first.run()
    resumed = make_trainer("run", *short, "frames=320")
    assert resumed.resume()
    assert "Nothing will be learned" in resumed.algorithm.learns_from
    assert "when it holds 321 new ones" in resumed.algorithm.lost_on_resume
    resumed.algorithm.steps_per_decision = 3
    assert "when it holds 107 new ones" in resumed.algorithm.lost_on_resume
    assert make_trainer("longer", *short, "frames=480").algorithm.learns_from == ""
    equal = (*short, "frames=320", "exploration.random_steps=320")
    for steps, nothing in ((1, False), (3, True)):  # the last steps wait for their n-step returns
        trainer = make_trainer(f"equal{steps}", *equal, f"memory.n_steps={steps}")
        assert bool(trainer.algorithm.learns_from) == nothing
        assert (finished(trainer)["policy_num_updates"][-1] == 0) == nothing


def test_the_update_to_data_ratio_holds_for_fractions(make_trainer):
    table = finished(make_trainer("run", "algo=sac", "policy_update.updates_per_step=0.021"))
    # 3.36 of an epoch: the first one's are due as well, the replay buffer being full enough
    assert sum(table["policy_num_updates"]) == int(8 * 160 * 0.021) == 26
    assert set(table["policy_num_updates"]) == {3, 4}


def test_a_delayed_policy_moves_every_other_step(make_trainer):
    trainer, seen = make_trainer("run", "algo=td3", "policy_update.policy_delay=10000"), []
    batches, networks = iter(trainer.collector), trainer.algorithm.networks
    for _ in range(2):
        seen.append({n: [p.detach().clone() for p in networks[n].parameters()] for n in networks})
        trainer.epoch(batches)
    first, later = seen[1], {name: list(network.parameters()) for name, network in networks.items()}
    assert any(
        not torch.equal(*pair) for pair in zip(seen[0]["actor"], first["actor"], strict=True)
    )
    assert all(map(torch.equal, first["actor"], later["actor"]))
    assert not any(map(torch.equal, first["critic"], later["critic"]))


def test_multipliers_go_by_the_costs_of_episodes(make_trainer):
    """Not by what the critics say, which are trained on discounted costs."""
    keys = ["lagrangian=projected", "limits=null", "cost_limits={cost: 2}"]
    table, penalty = finished(make_trainer("run", "algo=sac_lagrangian", *keys)), 0.0
    for cost, found in zip(table["episode_cost"], table["multiplier_cost"], strict=True):
        penalty = min(max(penalty + 0.01 * (cost - 2.0), 0.0), 2.0)
        assert found == pytest.approx(penalty, abs=1e-5)


def test_sums_over_steps_end_where_a_resumed_run_begins_new_episodes(tmp_path):
    def build():
        config = off_policy_config("algo=sac", "memory.n_steps=3", "frames=160")
        # after 40 steps, episodes of 30 are open
        return trainer_of(config, tmp_path / "run", Forgetful(4, 30, config.seed))

    build().run()
    resumed = build()
    assert resumed.resume()
    resumed.epoch(iter(resumed.collector))
    # the last three of the first 40 steps in a row end there, the last three of all are kept back
    assert len(resumed.algorithm.replay_buffer) == 4 * (40 + 37)
    spanned = resumed.algorithm.replay_buffer.state_dict()["steps"]["steps_to_next_obs"].flatten()
    assert spanned[4 * 37 : 4 * 40].tolist() == [3, 2, 1] * 4


def test_another_run_starts_from_its_networks(make_trainer, tmp_path):
    first = make_trainer("first", "algo=sac_lagrangian", "frames=320")
    first.run()

    def start(name, *overrides):
        config = off_policy_config(*overrides, f"init_from={tmp_path / 'first'}", "seed=1")
        algorithm = make_trainer(name, *overrides, "seed=1").algorithm
        return algorithm, begin_from(algorithm, config)

    second, taken = start("second", "algo=sac_lagrangian")
    assert taken == ["actor", "critic", "cost_critic"]
    ours, theirs = (each.networks["cost_critic"].parameters() for each in (first.algorithm, second))
    assert all(torch.equal(a, b) for a, b in zip(ours, theirs, strict=True))
    # target networks start from them, too
    loss = second.policy_update.loss
    for name in ("qvalue_network_params", "cost_qvalue_network_params"):
        targets, sources = (getattr(loss, prefix + name).data for prefix in ("target_", ""))
        assert (targets == sources).all()
    # critics of other costs do not, and no mean becomes the variance that is as large
    assert start("third", "algo=sac_lagrangian", "cost_limits={cost_north: 1}")[1] == taken[:2]
    assert start("fourth", "algo=wcsac")[1] == taken[:2]


class ToldOfCosts(SACLagrangianLoss):
    def __init__(self, *networks, cost_limits, **settings):
        super().__init__(*networks, **settings)
        self.limits = dict(cost_limits)

    def prepare(self, batch, limits):
        super().prepare(batch, limits)
        self.target = limits.target.item()


def test_a_loss_of_ones_own_is_passed_the_limits_and_their_state(make_trainer):
    allow(__name__)
    own = f"loss._target_={__name__}.ToldOfCosts"
    trainer = make_trainer("run", "algo=sac_lagrangian", own, "frames=320")
    trainer.run()
    loss = trainer.algorithm.policy_update.loss
    assert 0 < loss.target <= 25.0
    assert loss.limits == {"cost": 25.0}


@pytest.mark.parametrize("algo", ["sac", "td3"])
def test_evaluation_finds_its_policy_without_what_explores(algo, make_trainer, tmp_path):
    trainer = make_trainer("run", f"algo={algo}", "frames=320")
    trainer.run()
    env = PointMass(2, 20)
    checkpoint = Run(tmp_path / "run").find_checkpoint("last")
    policy = load_policy(Run(tmp_path / "run").config, env, checkpoint, torch.device("cpu"))
    state = env.reset()
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        expected = trainer.algorithm.policy(state.clone())["action"]
        assert torch.equal(policy(state.clone())["action"], expected)
    samples = torch.stack([policy(state.clone())["action"] for _ in range(2)])
    assert torch.equal(*samples) is (algo == "td3")
    episodes = collect_episodes(env, policy, 3, env.cost_keys, deterministic=False)
    assert episodes.lengths.tolist() == [20, 20, 20]


def test_it_is_evaluated_in_between_without_noise_and_without_consequences(tmp_path):
    def train(name, interval=None):
        config = off_policy_config("algo=sac", "frames=800")
        evaluation = None
        if interval:
            evaluation = partial(
                periodic_evaluation, partial(PointMass, num_steps=20),
                cost_keys=["cost"], interval=interval, episodes=6, seed=5, fixed_layout=False,
            )  # fmt: skip
        trainer = trainer_of(config, tmp_path / name, make_evaluation=evaluation)
        return trainer, finished(trainer)

    trainer, evaluated = train("evaluated", interval=400)
    _, plain = train("plain")
    columns = {"evaluation_return", "evaluation_cost"}
    assert set(evaluated) - set(plain) == columns
    assert evaluated["policy_loss_actor"][1:] == plain["policy_loss_actor"][1:]
    assert evaluated["episode_return"] == plain["episode_return"]
    known = [not math.isnan(value) for value in evaluated["evaluation_return"]]
    assert known == [False, False, True, False, True]
    policy, env = trainer.algorithm.policy, PointMass(6, 20, seed=805)
    expected = collect_episodes(env, policy, 6, ["cost"], deterministic=True)
    assert evaluated["evaluation_return"][-1] == pytest.approx(expected.returns.mean().item())
    assert evaluated["evaluation_cost"][-1] == expected.costs["cost"].mean().item()


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["algo=sac", "memory.capacity=100"], "must hold 160 transitions, those of exploration"),
        (["algo=sac", "exploration.noise=0.3"], r"noise=0\.3.*algo=sac samples its actions"),
        (["algo=sac_lagrangian", "cost_limits={}"], "Without constraints use algo=ppo or algo=sac"),
    ],
)
def test_what_could_not_learn_is_refused(overrides, message):
    with pytest.raises(ValueError, match=message):
        OffPolicy.from_config(off_policy_config(*overrides), PointMass(2))


def test_without_limits_no_critics_of_costs_are_needed():
    OffPolicy.from_config(off_policy_config("algo=sac", "critics.costs=0"), PointMass(2))


def test_what_is_held_against_the_limit_is_the_mean_of_the_worst_episodes(make_trainer):
    config = ["algo=wcsac", "frames=8000", "frames_per_batch=1600", "exploration.random_steps=8000"]
    trainer = make_trainer("run", *config, "risk.tail=0.25")
    costs, rows, batches = [], [], iter(trainer.collector)
    update = trainer.accounting.update
    trainer.accounting.update = lambda batch: (costs.append(found := update(batch)), found)[1]
    for _ in range(5):
        rows.append(trainer.epoch(batches))
    of_episodes = torch.cat([found.costs["cost"] for found in costs[1:]]).sort().values
    worst = of_episodes[-len(of_episodes) // 4 :].mean().item()
    estimates = [row["estimate_cost"] for row in rows[1:]]
    assert worst > 1.5 * of_episodes.mean().item()
    assert sum(estimates) / 4 == pytest.approx(worst, rel=0.1)
    assert rows[-1]["violation_cost"] == pytest.approx(rows[-1]["estimate_cost"] - 25.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("algo", "words"),
    # the policy of TD3 is deterministic: with some other seeds it stays on the straight way
    [("sac_lagrangian", []), ("td3_lagrangian", ["lagrangian.ki=0.2"])],
)
def test_it_learns_to_go_around_a_hazard(algo, words, tmp_path):
    """The origin is 1.2 away and the hazard on the straight way, of which five steps lie in it."""
    config = off_policy_config(
        *(f"algo={algo}", "frames=24_000", "frames_per_batch=400", "cost_limits={cost: 1}"),
        *("policy_update.updates_per_step=0.2", "limits.free_steps=6000"),
        *("limits.descent_steps=6000", "exploration.random_steps=800", "memory.keep=false"),
        *("model.hidden_sizes=[64, 64]", "memory.batch_size=128"),
        *words,
    )
    table = finished(trainer_of(config, tmp_path))
    # λ of the deterministic policy swings afterwards, on some processors more than on others
    returns, costs = (
        torch.tensor(table[name]).unfold(0, 20, 1).mean(1)
        for name in ("episode_return", "episode_cost")
    )
    assert ((returns > 0.9) & (costs < 1.5)).any()


class Broken(PointMass):
    """Gives one wrong number in the third step of its first row."""

    key, number = "cost", torch.nan

    def _step(self, tensordict):
        step = super()._step(tensordict)
        step[self.key][0] = torch.where(self._step_count[0] == 3, self.number, step[self.key][0])
        return step


@pytest.mark.parametrize(
    ("algo", "key"),
    [
        *(("sac_lagrangian", key) for key in ("cost", "reward", "observation")),
        ("ppo_lagrangian", "cost"),
    ],
)
def test_a_wrong_number_is_refused_in_the_batch_in_which_it_arrives(algo, key, tmp_path):
    config = (off_policy_config if algo != "ppo_lagrangian" else compose_config)(
        "env=PointMass", f"algo={algo}", "num_envs=4", "frames_per_batch=160", "logger=none"
    )
    env = Broken(4, 20)
    env.key = key
    trainer = trainer_of(config, tmp_path, env)
    with pytest.raises(FloatingPointError, match=rf"{key}' is not finite .* environment 0 at st"):
        trainer.run()
    assert not len(getattr(trainer.algorithm, "replay_buffer", ()))


def test_costs_below_0_are_refused_where_policies_are_evaluated():
    """Also if the sum of the episode is above 0."""
    env = Broken(2, 20)
    env.number = -0.5
    with pytest.raises(EpisodeError, match="'cost' is below 0"):
        collect_episodes(env, RandomPolicy(env.action_spec), 2, ["cost"], deterministic=False)
    env.number = torch.inf
    with pytest.raises(FloatingPointError, match="'cost' is not finite in 1 of 2"):
        collect_episodes(env, RandomPolicy(env.action_spec), 2, ["cost"], deterministic=False)
