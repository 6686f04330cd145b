"""Episode accounting against a plain loop over environments and steps."""

import math

import pytest
import torch
from point_mass import PointMass
from tensordict import TensorDict
from torchrl.collectors import Collector

from safe_rl.collectors import EpisodeAccounting, EpisodeError

COST_KEYS = ["cost", ("agent", "cost_speed")]


def random_batch(generator, num_envs, num_steps, done_probability):
    shape = (num_envs, num_steps, 1)
    step = TensorDict(
        reward=torch.randn(shape, generator=generator),
        cost=torch.randint(0, 3, shape, generator=generator).float(),
        agent={"cost_speed": torch.rand(shape, generator=generator)},
        done=torch.rand(shape, generator=generator) < done_probability,
        batch_size=[num_envs, num_steps],
    )
    return TensorDict({"next": step}, [num_envs, num_steps])


def signals_of(batch):
    """Reward and costs, [N, T, 3]."""
    entries = [batch["next", key] for key in ("reward", "cost", ("agent", "cost_speed"))]
    return torch.cat(entries, -1).double()


def loop_over_steps(batch, unfinished):
    """Reward, costs and length of the episodes that end; sums of the others stay in a list."""
    finished = []
    for row, steps in enumerate(signals_of(batch).tolist()):
        for step, done in zip(steps, batch["next", "done"][row], strict=True):
            unfinished[row] = [s + x for s, x in zip(unfinished[row], [*step, 1], strict=True)]
            if done:
                finished.append(unfinished[row])
                unfinished[row] = [0.0] * 4
    return finished


def test_batches_of_other_episodes_than_those_that_are_open_are_refused():
    """As an asynchronous collector returns those of its workers in turn."""

    def batch(ids, ends):
        shape = (2, 3, 1)
        done = torch.tensor(ends).expand(2, 3).unsqueeze(-1)
        step = {"reward": torch.ones(shape), "cost": torch.ones(shape), "done": done}
        names = torch.tensor(ids).expand(2, 3).unsqueeze(-1)
        return TensorDict({"next": step, "collector": {"traj_ids": names}}, [2, 3])

    accounting = EpisodeAccounting(2, ["cost"])
    accounting.update(batch([4, 4, 4], [False, False, False]))
    accounting.update(batch([4, 7, 7], [True, False, True]))
    assert accounting.update(batch([9, 9, 9], [False] * 3)).lengths.tolist() == []
    for ids, ends in (([8, 8, 8], [True] * 3), ([9, 8, 8], [False, False, True])):
        with pytest.raises(ValueError, match=r"do not continue the episodes.* cat_results=0"):
            accounting.update(batch(ids, ends))
    accounting.forget_open_episodes()
    assert accounting.update(batch([8, 8, 8], [False, False, True])).lengths.tolist() == [3.0] * 2


def test_padding_is_no_step():
    batch = random_batch(torch.Generator().manual_seed(0), 2, 4, 0.2)
    batch["collector", "mask"] = torch.ones(2, 4, dtype=torch.bool)
    EpisodeAccounting(2, COST_KEYS).update(batch)
    batch["collector", "mask"][1, 3] = False
    with pytest.raises(ValueError, match=r"padding.* split_trajs=False"):
        EpisodeAccounting(2, COST_KEYS).update(batch)


def test_ends_of_batches_that_are_no_ends_of_episodes_are_refused():
    accounting = EpisodeAccounting(2, ["cost"])
    settings = {"frames_per_batch": 6, "total_frames": 12, "set_truncated": True}
    first, second = (batch.clone() for batch in Collector(PointMass(2), **settings))
    accounting.update(first)
    with pytest.raises(ValueError, match="set_truncated=False"):
        accounting.update(second)


def test_a_single_environment_needs_no_batch_dimension():
    generator = torch.Generator().manual_seed(0)
    batch = random_batch(generator, 1, 40, 0.2)
    rows = [EpisodeAccounting(1, COST_KEYS).update(data).scalars() for data in (batch, batch[0])]
    assert rows[0] == rows[1]
    with pytest.raises(ValueError, match="2 environments"):
        EpisodeAccounting(2, COST_KEYS).update(batch[0])
    with pytest.raises(KeyError, match="cost_hazard"):
        EpisodeAccounting(1, ["cost_hazard"]).update(batch)


@pytest.mark.parametrize("done_probability", [0.0, 0.02, 0.3, 1.0])
@pytest.mark.parametrize(("num_envs", "num_steps"), [(1, 7), (3, 40), (5, 1)])
def test_agrees_with_a_loop_over_several_batches(num_envs, num_steps, done_probability):
    generator = torch.Generator().manual_seed(num_envs + num_steps)
    accounting = EpisodeAccounting(num_envs, COST_KEYS)
    unfinished, seen = [[0.0] * 4] * num_envs, []
    for _ in range(4):
        batch = random_batch(generator, num_envs, num_steps, done_probability)
        statistics, finished = accounting.update(batch), loop_over_steps(batch, unfinished)
        seen.append(signals_of(batch))
        assert statistics.num_episodes == len(finished)
        expected = torch.tensor(finished, dtype=torch.float64).reshape(-1, 4)
        columns = [
            statistics.returns,
            statistics.costs["cost"],
            statistics.costs["agent/cost_speed"],
            statistics.lengths,
        ]
        torch.testing.assert_close(torch.stack(columns, -1), expected)
        row = statistics.scalars()
        logged = [row[f"episode_{key}"] for key in ("return", "cost", "agent/cost_speed", "length")]
        assert logged == pytest.approx(expected.mean(0).tolist(), nan_ok=True)
        means = statistics.mean_costs(["cost"]).tolist()
        assert means == pytest.approx([expected[:, 1].mean().item()], nan_ok=True)
        assert row["episodes"] == len(finished)
        logged = [row[key] for key in ("reward_rate", "cost_rate", "agent/cost_speed_rate")]
        assert logged == pytest.approx(torch.cat(seen, 1).mean((0, 1)).tolist())


def test_episodes_that_are_open_can_be_left_out_of_the_statistics_of_episodes():
    generator = torch.Generator().manual_seed(0)
    whole, partial = EpisodeAccounting(3, COST_KEYS), EpisodeAccounting(3, COST_KEYS)
    partial.ignore_open_episodes()
    for _ in range(6):
        batch = random_batch(generator, 3, 10, 0.05)
        everything, rest = whole.update(batch), partial.update(batch)
        assert everything.cost_rates == rest.cost_rates
        assert set(rest.returns.tolist()) <= set(everything.returns.tolist())
        # what risk measures charge: of all episodes
        torch.testing.assert_close(everything.open_costs, rest.open_costs, rtol=0, atol=0)
        if partial.open_sums.isfinite().all():
            break
    assert partial.open_sums.isfinite().all()
    batch = random_batch(generator, 3, 40, 0.1)
    assert torch.equal(whole.update(batch).returns, partial.update(batch).returns)


def steps_of(costs, done):
    """A batch of one row, [1, T]."""
    columns = torch.tensor(costs).view(1, -1, 1), torch.tensor(done).view(1, -1, 1)
    step = {"reward": torch.ones_like(columns[0]), "cost": columns[0], "done": columns[1]}
    return TensorDict({"next": step}, [1, len(costs)])


def test_a_decision_counts_as_the_steps_that_it_takes_and_the_last_as_a_whole_one():
    steps = steps_of([1.0, 0.0, 1.0], [False, False, True])
    steps["next", "steps_taken"] = torch.tensor([3, 3, 2]).view(1, 3, 1)
    found = EpisodeAccounting(1, ["cost"], steps_per_decision=3).update(steps)
    assert (found.lengths.item(), found.decisions.item(), found.steps) == (8, 3, 8)
    assert found.cost_rates["cost"].item() == 2 / 8


def test_costs_below_0_are_refused_with_their_name():
    accounting = EpisodeAccounting(1, ["cost"])
    with pytest.raises(EpisodeError, match=r"'cost' is below 0 in 2 of 3 steps.*0 or more"):
        accounting.update(steps_of([-1.0, 0.0, -0.5], [False, False, True]))
    accounting.update(steps_of([0.0, 1.0], [False, True]))
    steps = steps_of([-1.0], [True])
    steps["next", "cost_own"] = steps["next", "cost"]
    with pytest.raises(EpisodeError, match="'cost_own' is below 0"):  # of which it is the sum
        EpisodeAccounting(1, ["cost", "cost_own"]).update(steps)
    steps["next", "cost"] = torch.ones(1, 1, 1)
    with pytest.raises(EpisodeError, match="'cost_own' is below 0"):  # beside one that is not
        EpisodeAccounting(1, ["cost", "cost_own"]).update(steps)
    steps["next", "cost"] = steps["next", "cost_own"]
    steps["next", "of", "cost"] = steps["next"].pop("cost_own")
    with pytest.raises(EpisodeError, match="'of/cost' is below 0"):
        EpisodeAccounting(1, ["cost", ("of", "cost")]).update(steps)


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize(
    "key", ["observation", "action", ("next", "observation"), ("next", "reward"), ("next", "cost")]
)
def test_numbers_that_are_not_finite_are_refused_with_entry_and_row(key, number):
    batch, accounting = PointMass(3).rollout(6), EpisodeAccounting(3, ["cost"])
    batch[key][1, 4] = number
    name = key if isinstance(key, str) else key[-1]
    with pytest.raises(FloatingPointError, match=f"{name}' is not .* 1 of 18 .*ment 1 at step 4"):
        accounting.update(batch)
    assert not accounting.have_begun.any()


@pytest.mark.parametrize("ends", [True, False])
def test_episodes_that_are_too_long_are_refused_open_or_ended(ends):
    accounting = EpisodeAccounting(1, ["cost"], longest=3)
    accounting.ignore_open_episodes()  # which nobody knows the length of
    accounting.update(steps_of([0.0] * 9, [False] * 8 + [True]))
    accounting.update(steps_of([0.0] * 3, [False] * 3))
    with pytest.raises(EpisodeError, match=r"has 4 steps.*'max_episode_steps' is 3"):
        accounting.update(steps_of([0.0], [ends]))


def test_numbers_of_several_agents_are_no_cost_of_a_step():
    step = {"reward": torch.ones(2, 5, 1), "cost": torch.ones(2, 5, 3, 1)}
    step["done"] = torch.zeros(2, 5, 1, dtype=torch.bool)
    accounting = EpisodeAccounting(2, ["cost"])
    with pytest.raises(ValueError, match=r"'cost'\) has the shape \[2, 5, 3, 1\], .*\[2, 5, 1\]"):
        accounting.update(TensorDict({"next": step}, [2, 5]))


def test_steps_come_one_at_a_time_without_a_last_dimension():
    step = {"reward": torch.ones(2, 1), "done": torch.ones(2, 1, dtype=torch.bool)}
    assert EpisodeAccounting(2, []).update(TensorDict({"next": step}, [2, 1])).num_episodes == 2


@pytest.mark.parametrize("name", ["return", "length"])
def test_no_cost_takes_the_column_of_returns_or_lengths(name):
    with pytest.raises(ValueError, match=f"'{name}': episode_{name} is another column"):
        EpisodeAccounting(1, ["cost", name])
