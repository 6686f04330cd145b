"""The best policies: evaluated by episodes whose policies are known by construction."""

import pytest
import torch

from safe_rl.runs.table import keeps
from safe_rl.training.checkpoint_selection import CheckpointSelection
from safe_rl.training.state import Progress

EPISODE = 1000


def epochs(values, rows, steps):
    """Rows of a table: policy i is worth values[i] per episode, and collects batch i.

    Row k of N begins its episodes at step k · 1000 / N; those that end in a batch are a mean over
    the policies that collected their steps.
    """
    worth = torch.tensor(values).repeat_interleave(steps) / EPISODE
    sums = worth.cumsum(0)
    for epoch in range(1, len(values) + 1):
        ends = [
            end
            for row in range(rows)
            for end in range(EPISODE - row * EPISODE // rows, epoch * steps + 1, EPISODE)
            if end > (epoch - 1) * steps and end >= EPISODE
        ]
        returns = [float(sums[end - 1] - (sums[end - 1001] if end > 1000 else 0)) for end in ends]
        mean = sum(returns) / len(returns) if returns else float("nan")
        yield {"epoch": epoch, "steps": epoch * steps * rows, "episode_return": mean}


def evaluate(values, rows, steps, over=3):
    policy = Progress()
    options = {"over": over, "steps_per_epoch": steps, "longest": EPISODE}
    selection = CheckpointSelection({"policy": policy}, {}, **options)
    evaluated = []
    for row in epochs(values, rows, steps):
        # what collected this batch was policy epoch − 1; the update makes it the next one
        policy.epoch = row["epoch"]
        evaluated += selection.add(row)
    return {one["states"]["policy"]["epoch"]: one["score"] for one in evaluated}


@pytest.mark.parametrize(("rows", "steps"), [(100, 200), (20, 1000), (50, 500), (100, 100)])
def test_the_score_of_a_policy_is_that_of_the_episodes_around_it(rows, steps):
    # a hill of returns: whoever is evaluated by episodes of earlier policies finds a later summit
    summit = 24
    values = [-abs(number - summit) / 4 + 10.0 for number in range(48)]
    scores = evaluate(values, rows, steps)
    best = max(scores, key=scores.get)
    assert abs(best - summit) <= 1
    lag = EPISODE // steps
    for number in range(2 * lag, len(values) - 2 * lag):
        assert scores[number] == pytest.approx(values[number], abs=0.15 * max(lag, 2))


def test_a_single_epoch_of_whole_episodes_judges_the_policy_that_played_them():
    scores = evaluate([float(number % 7) for number in range(20)], rows=1, steps=1000, over=1)
    assert scores == pytest.approx({number: float(number % 7) for number in range(1, 20)})


def test_limits_are_held_against_the_mean_of_the_epochs():
    selection = CheckpointSelection({}, {"cost": 25.0}, over=2, steps_per_epoch=1, longest=1)
    kept = []
    for epoch, cost in enumerate((20.0, 28.0, 30.0, 16.0, 10.0), 1):
        row = {"epoch": epoch, "steps": epoch, "episode_return": 1.0, "episode_cost": cost}
        kept += [one["steps"] for one in selection.add(row)]
    # means of 29, 23, 13, of which each judges the policy of two epochs before
    assert kept == [2, 3]
    assert [one["steps"] for one in selection.score_all()] == [4, 5]
    assert [policy["steps"] for policy in selection.waiting] == [4, 5]


@pytest.mark.parametrize(
    ("estimate", "target", "is_kept"),
    [(24.0, 22.0, False), (25.0, 30.0, True), (28.0, 30.0, False)],
)
def test_an_estimate_has_to_be_at_its_target_and_within_the_limit(estimate, target, is_kept):
    # with costs exactly at the limit
    row = {"episode_cost": 25.0, "estimate_cost": estimate, "target_cost": target}
    assert keeps(row, "cost", 25.0) is is_kept


def test_what_waits_is_a_copy_and_survives_a_checkpoint():
    network = torch.nn.Linear(1, 1)
    row = {"episode_return": 1.0}
    first = CheckpointSelection({"network": network}, {}, over=1, steps_per_epoch=1, longest=1)
    assert first.add({"epoch": 1, "steps": 1, **row}) == []
    before = network.weight.detach().clone()
    with torch.no_grad():
        network.weight.add_(1.0)
    second = CheckpointSelection({"network": network}, {}, over=1, steps_per_epoch=1, longest=1)
    second.load_state_dict(first.state_dict())
    (evaluated,) = second.add({"epoch": 2, "steps": 2, **row})
    assert evaluated["steps"] == 1
    assert torch.equal(evaluated["states"]["network"]["weight"], before)


def test_of_short_episodes_nobody_waits_as_if_they_were_long():
    options = {"over": 1, "steps_per_epoch": 200, "longest": 1000}
    selection = CheckpointSelection({}, {}, **options)
    evaluated = []
    for epoch, length in enumerate((float("nan"), 1000.0, 1000.0, 50.0, 50.0, float("nan")), 1):
        row = {"epoch": epoch, "steps": epoch, "episode_return": epoch, "episode_length": length}
        evaluated.append([(one["steps"], one["score"]) for one in selection.add(row)])
    # the batch after their update, once it is known that episodes are short
    assert evaluated == [[], [], [], [(3, 4)], [(4, 5)], [(5, 6)]]
    again = CheckpointSelection({}, {}, **options)
    again.take({"episode_length": 50.0})
    row = {"epoch": 7, "steps": 7, "episode_return": 7.0}
    assert [again.add(row), [one["steps"] for one in again.add(row | {"steps": 8})]] == [[], [7]]
