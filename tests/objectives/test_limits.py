"""From costs to violations: the descent, the margin, trust in predictions, exact continuation."""

import pytest
import torch
from samples import LIMITS, make_actor, make_batch
from tensordict import TensorDict

from safe_rl.algorithms import Constraints
from safe_rl.collectors import EpisodeStatistics
from safe_rl.objectives import PIMultiplier, ProjectedMultiplier, RCPOLoss
from safe_rl.objectives.limits import LimitState, LimitTracker, PredictedChange

STEPS = {"max_length": 1000, "free_steps": 4_000, "descent_steps": 10_000, "frames": 1_000_000}


def tracker(*limits: float, **settings) -> LimitTracker:
    return LimitTracker(torch.tensor(limits or (25.0,)), **LIMITS | STEPS | settings)


def batches(number: int, rate: float, seed: int = 0, unit: float = 1.0) -> list[torch.Tensor]:
    """Indicator costs of 20 rows of 100 steps, times `unit`."""
    generator = torch.Generator().manual_seed(seed)
    return [
        unit * (torch.rand(20, 100, 1, generator=generator) < rate).float() for _ in range(number)
    ]


NO_EPISODES = torch.empty(0)
NOTHING_ENDED = EpisodeStatistics(NO_EPISODES, {}, NO_EPISODES, {})
GAINS = {"init": 0.0, "kp": 1.0, "ki": 0.1, "saturation": 0.5, "highest": 5.0}


def test_costs_are_free_then_the_limit_comes_down_from_what_the_policy_costs():
    limits = tracker(margin=0.0, drift=None)
    costs = torch.full((20, 100, 1), 0.1)
    states = [limits.update(costs, NO_EPISODES) for _ in range(10)]
    assert [bool(state.violation < 0) for state in states] == [True] * 2 + [False] * 8
    targets = torch.cat([state.target for state in states[2:]])
    torch.testing.assert_close(targets[:5], torch.tensor([85.0, 70, 55, 40, 25]))
    assert (targets[5:] == 25).all()


@pytest.mark.parametrize(
    ("steps", "words"),
    [(0, ""), (10_000, "The limits fall until step 10,000 and are constant from there.")],
)
def test_the_schedule_says_until_when_limits_fall(steps, words):
    assert tracker(free_steps=0, descent_steps=steps).schedule == words


def test_in_a_short_run_the_descent_is_over_in_time():
    limits = tracker(margin=0.0, drift=None, frames=10_000)
    assert (limits.free_steps, limits.descent_steps) == (2_000, 5_000)
    costs = torch.full((20, 25, 1), 0.1)
    states = [limits.update(costs, NO_EPISODES) for _ in range(20)]
    assert [bool(state.violation < 0) for state in states] == [True] * 4 + [False] * 16
    assert [bool(state.target == 25) for state in states] == [False] * 13 + [True] * 7


def test_a_run_that_is_made_longer_during_its_descent_has_no_free_steps_again():
    costs = torch.full((20, 25, 1), 0.1)
    short = tracker(margin=0.0, drift=None, frames=10_000)
    before = [short.update(costs, NO_EPISODES).target for _ in range(6)][-1]
    longer = tracker(margin=0.0, drift=None)
    longer.load_state_dict(short.state_dict())
    after = [longer.update(costs, NO_EPISODES).target for _ in range(3)]
    assert longer.free_steps == 4_000  # of which 4,500 are over by the last
    assert before > after[0] > after[1] > after[2] > 25


def test_the_descent_goes_on_from_the_cost_where_that_came_down_faster():
    limits = tracker(margin=0.0, free_steps=0, drift=None)
    limits.update(torch.full((20, 100, 1), 0.1), NO_EPISODES)
    state = limits.update(torch.full((20, 100, 1), 0.045), NO_EPISODES)
    assert state.target == pytest.approx(45 - 20 / 4)
    # and never up again
    later = limits.update(torch.full((20, 100, 1), 0.2), NO_EPISODES)
    assert later.target < state.target
    # of a policy that costs less than its limit from the first, it is the limit
    cheap = tracker(margin=0.0, free_steps=0, drift=None)
    states = [cheap.update(torch.full((20, 100, 1), 0.01), NO_EPISODES) for _ in range(3)]
    assert [state.target for state in states] == [25.0] * 3


def test_the_margin_is_a_number_of_standard_errors_of_a_batch():
    limits = tracker(50.0, margin=2.0, free_steps=0, descent_steps=0, decay=0.99, largest_margin=1)
    for costs in batches(500, rate=0.05):
        target = limits.update(costs, NO_EPISODES).target
    # of 2000 independent steps, for an episode of 1000
    error = 1000 * (0.05 * 0.95 / 2000) ** 0.5
    assert target.item() == pytest.approx(50 - 2 * error, abs=0.5)


def test_a_limit_of_0_has_a_unit_and_no_margin():
    limits = tracker(0.0, free_steps=0, descent_steps=0)
    for costs in batches(3, 0.03):
        state = limits.update(costs, NO_EPISODES)
    assert state.target == 0
    assert state.scale == 10
    assert state.violation > 20


def test_a_limit_that_is_not_near_0_stays_the_unit_where_actions_are_held():
    """Held for 4 steps, a cost of 0 or 1 per step is up to 4 per decision."""
    limits = tracker(25.0, max_length=250, steps_per_decision=4)
    state = limits.update(*batches(1, 0.03, unit=4.0), NO_EPISODES)
    assert (state.unit, state.scale) == (4, 25)


@pytest.mark.parametrize("size", [0.01, 1000.0])
def test_plain_dual_ascent_weighs_costs_of_any_size_alike(size):
    """Its λ weighs advantages in units of one cost, and so has to move by violations in them."""
    found = []
    for unit in (1.0, size):
        limits = tracker(25.0 * unit)
        multiplier = ProjectedMultiplier(25.0 * unit, init=2.0, lr=0.01, highest=None)
        torch.manual_seed(0)
        loss = RCPOLoss(make_actor(), multiplier, clip_epsilon=0.2, entropy_coeff=0.0)
        for costs in batches(5, 0.05, unit=unit):
            state = limits.update(costs, NO_EPISODES)
            multiplier.update(state)
        samples = make_batch(loss.actor_network, [50])
        samples["cost_advantage"] *= unit
        weighed = loss(loss.prepare(samples, state))["loss_objective"]
        found.append(torch.stack([multiplier.value[0], weighed]))
    assert found[0][0] > 1.0
    torch.testing.assert_close(*found)


def test_predictions_per_step_are_held_against_the_costs_of_episodes():
    """Of 20 per episode half was realised, beside a first prediction of half of the limit."""
    constraints = Constraints({"cost": 25.0}, tracker=tracker())
    for rate in (0.05, 0.04):
        costs = torch.full((20, 100, 1), rate)
        state = constraints.update(TensorDict({"next": {"cost": costs}}, [20, 100]), NOTHING_ENDED)
        constraints.record_prediction(state, {"cost_surrogate": torch.tensor([-20 / 1000])})
    prior = 0.9 * 12.5**2
    share = (prior + 20 * 10) / (prior + 20**2)
    assert constraints.columns(state, None)["trust_cost"] == pytest.approx(share)


@pytest.mark.parametrize(("kept", "share"), [(-0.5, 0.1), (0.2, 0.2), (0.7, 0.7), (1.5, 1.0)])
def test_trust_finds_the_share_of_predictions_that_is_realised(kept, share):
    generator = torch.Generator().manual_seed(0)
    predictions = PredictedChange(1, decay=0.98, lowest=0.1)
    cost, shares = torch.tensor([400.0]), []
    for step in range(400):
        predicted = -20 * torch.rand(1, generator=generator) * (1 if step % 20 else -15)
        predictions.update(cost + 5 * torch.randn(1, generator=generator), torch.tensor([10.0]))
        predictions.record_prediction(predicted)
        shares.append(predictions.share)
        cost = cost + kept * predicted
    assert torch.stack(shares[100:]).mean() == pytest.approx(share, abs=0.05)


def test_a_violation_that_stays_is_asked_for_more_and_more_up_to_a_bound():
    limits = tracker(free_steps=0, descent_steps=0, margin=0.0, drift=None, integral=0.1)
    states = [limits.update(torch.full((20, 100, 1), 0.03), NO_EPISODES) for _ in range(40)]
    required = torch.cat([state.required_decrease for state in states])
    torch.testing.assert_close(required[:3], torch.tensor([5.5, 6.0, 6.5]))
    assert required[-1] == 5 + 12.5
    # a cost below the limit takes it back
    states = [limits.update(torch.full((20, 100, 1), 0.01), NO_EPISODES) for _ in range(10)]
    assert states[-1].required_decrease == -15
    # of a violation no more counts than its unit
    limits = tracker(free_steps=0, descent_steps=0, margin=0.0, drift=None, integral=0.1)
    assert limits.update(torch.full((20, 100, 1), 0.1), NO_EPISODES).integral == 2.5


def test_costs_that_come_late_are_seen():
    """Of batches without any cost there is no spread, and no share of nothing to drift by."""
    limits = tracker(margin=0.0, free_steps=0, descent_steps=0)
    for _ in range(5):
        limits.update(torch.zeros(20, 100, 1), NO_EPISODES)
    for costs in batches(12, 0.06):
        state = limits.update(costs, NO_EPISODES)
    assert state.cost.item() > 40
    assert state.violation.item() > 15


def test_a_saved_state_goes_on_as_if_it_had_never_stopped():
    whole, second = tracker(), tracker()
    *before, last = batches(6, 0.06)
    for costs in before:
        whole.update(costs, torch.tensor([90.0]))
        whole.predictions.record_prediction(torch.tensor([-3.0]))
    second.load_state_dict(whole.state_dict())
    states = [each.update(last, NO_EPISODES) for each in (whole, second)]
    tensors = [[v for v in vars(state).values() if torch.is_tensor(v)] for state in states]
    assert all(map(torch.equal, *tensors))


def test_another_default_dtype_of_torch_changes_nothing():
    """As after `torch.set_default_dtype(torch.float64)` in a notebook."""
    states, steps = [], batches(8, 0.06)
    for dtype in (torch.float32, torch.float64):
        torch.set_default_dtype(dtype)
        try:
            limits, multiplier = tracker(), PIMultiplier([25.0], **GAINS)
            for costs in steps:
                state = limits.update(costs, torch.tensor([90.0]))
                limits.predictions.record_prediction(torch.tensor([-3.0]))
                multiplier.update(state)
        finally:
            torch.set_default_dtype(torch.float32)
        states.append([v for v in vars(state).values() if torch.is_tensor(v)] + [multiplier.value])
    assert all(map(torch.equal, *states))
    assert all(value.dtype == torch.float32 for value in states[1])


def test_costs_without_limits_are_refused():
    with pytest.raises(ValueError, match="2 costs and 1 limits"):
        LimitState.of(cost=[31.0, 2.0], limit=[25.0])


def test_without_a_length_nothing_is_known_until_an_episode_has_finished():
    """The costs of a short batch are a part of an episode's."""
    batch = TensorDict({"next": {"cost": torch.full((3, 5, 1), 0.5)}}, [3, 5])
    open_episodes = EpisodeStatistics(NO_EPISODES, {"cost": NO_EPISODES}, NO_EPISODES, {})
    multiplier = ProjectedMultiplier({"cost": 25.0}, init=0.5, lr=0.01, highest=None)
    for length, violation in ((None, torch.nan), (100, 25.0)):
        state = Constraints({"cost": 25.0}, max_length=length).update(batch, open_episodes)
        assert state.violation.item() == pytest.approx(violation, nan_ok=True)
        multiplier.update(state)
        assert (multiplier.value == 0.5).all() == (length is None)


@pytest.mark.parametrize(
    ("batch_size", "shape", "told"),
    [
        ([5], (5, 1), r"shape \[5\].*batch\.unsqueeze\(0\)"),  # of one environment
        ([3, 5], (3, 5), r"must have the shape \[3, 5, 1\], got"),
        ([3, 5], (3, 5, 2), r"must have the shape \[3, 5, 1\], got"),
    ],
)
def test_batches_and_their_costs_need_their_dimensions(batch_size, shape, told):
    batch = TensorDict({"next": {"cost": torch.ones(shape)}}, batch_size)
    with pytest.raises(ValueError, match=told):
        Constraints({"cost": 1.0}, tracker=tracker()).update(batch, NOTHING_ENDED)


def test_costs_in_another_order_than_those_of_the_multiplier_are_refused():
    state = Constraints({"a": 5.0, "b": 1.0}, tracker=tracker(5.0, 1.0)).update(
        TensorDict({"next": {key: torch.ones(3, 5, 1) for key in "ab"}}, [3, 5]),
        NOTHING_ENDED,
    )
    for limits in ({"a": 5.0, "b": 1.0}, [5.0, 1.0]):  # without names nobody knows
        ProjectedMultiplier(limits, init=0.0, lr=0.01, highest=None).update(state)
    with pytest.raises(ValueError, match="another order"):
        ProjectedMultiplier({"b": 1.0, "a": 5.0}, init=0.0, lr=0.01, highest=None).update(state)


def test_a_state_of_one_limit_is_refused_by_parts_that_have_two():
    state = LimitState.of(cost=[30.0], limit=[25.0], length=100.0)
    multiplier = ProjectedMultiplier([25.0, 10.0], init=0.0, lr=0.01, highest=None)
    actor = make_actor()
    loss = RCPOLoss(actor, multiplier, clip_epsilon=0.2, entropy_coeff=0.0)
    batch = make_batch(actor, [8], 2)
    for use in (multiplier.update, lambda state: loss.prepare(batch, state)):
        with pytest.raises(ValueError, match=r"One limit for each of \['cost_0', 'cost_1'\]"):
            use(state)
    with pytest.raises(TypeError, match=r"got a Tensor.*LimitState.of\(cost="):
        multiplier.update(state.cost)


def test_every_limited_cost_has_to_be_counted():
    batch = TensorDict(next={"cost": torch.ones(1, 5, 1)}, batch_size=[1, 5])
    episodes = EpisodeStatistics(torch.ones(1), {}, torch.ones(1), {})
    with pytest.raises(KeyError, match="no 'cost': name it in EpisodeAccounting"):
        Constraints({"cost": 1.0}).update(batch, episodes)
