"""Held actions and observed costs, against single steps of the same environment."""

import pytest
import torch
from test_transforms import ENVIRONMENTS, Priced, still
from torchrl.envs.utils import check_env_specs

from safe_rl.envs import check_constrained_env, make_env
from safe_rl.envs.transforms import (
    ActionRepeat,
    EarlyTermination,
    ObservedCosts,
    Simmer,
    transform_env,
)
from safe_rl.evaluation.episodes import collect_episodes
from safe_rl.evaluation.video import manner_of, record_episode


def repeating(env, k, *before, **named):
    changes = {str(number): transform for number, transform in enumerate(before)}
    return transform_env(env, {**changes, "repeat": ActionRepeat(k)}, evaluating=False, **named)


@pytest.mark.parametrize("env", ENVIRONMENTS)
def test_specs_are_true_and_the_contract_is_kept(env):
    env = repeating(ENVIRONMENTS[env](), 3, EarlyTermination({"cost": 2.0}))
    check_env_specs(env)
    check_constrained_env(env)
    env.close()


@pytest.mark.parametrize("k", [1, 3, 4])
def test_sums_are_those_of_single_steps_over_several_episodes(k):
    # of episodes of 10 steps, repeats of 3 and 4 reach beyond the end
    config = {"robot_base": "point", "task": "goal", "num_steps": 10, "hazards_num": 8}
    config |= {"constrain_hazards": True, "hazards_keepout": 0.0, "hazards_size": 0.6}
    single, env = make_env(config, num_envs=3, seed=1), make_env(config, num_envs=3, seed=1)
    env = repeating(env, k)
    torch.manual_seed(0)
    decisions = -(-10 // k)
    held = env.rollout(2 * decisions, break_when_any_done=False)
    taken = held["next", "steps_taken"][..., 0] if k > 1 else torch.ones(3, 20, dtype=torch.int64)
    assert taken.sum(1).tolist() == [20, 20, 20]
    state = single.reset()
    for number in range(2 * decisions):
        after = held["next"][:, number]
        sums = dict.fromkeys(("reward", *env.cost_keys), torch.zeros(3, 1))
        for _ in range(int(taken[0, number])):
            state["action"] = held["action"][:, number]
            step, state = single.step_and_maybe_reset(state)
            sums = {key: total + step["next", key] for key, total in sums.items()}
        for key, total in sums.items():
            assert torch.equal(after[key], total), key
        for key in ("observation", "done", "truncated"):
            assert torch.equal(after[key], step["next", key]), key
    assert held["next", "cost"].sum() > 0


def test_a_row_that_ends_inside_a_repeat_stops_alone():
    costs = [[1.0, 2.0, 0.0, 4.0, 8.0, 16.0, 32.0, 64.0], [0.0, 0.0, 0.0, 1.0, 0.0, 1.0, 0.0, 0.0]]
    env = repeating(Priced(costs), 4, EarlyTermination({"cost": 2.5}))
    steps = still(env, 2)["next"]
    assert steps["cost"][..., 0].tolist() == [[3.0, 3.0], [1.0, 1.0]]
    assert steps["cost_north"][..., 0].tolist() == [[6.0, 6.0], [2.0, 2.0]]
    assert steps["steps_taken"][..., 0].tolist() == [[2, 2], [4, 4]]
    assert steps["terminated"][..., 0].tolist() == [[True, True], [False, False]]
    assert steps["truncated"][..., 0].tolist() == [[False, False], [False, True]]
    assert (env.max_episode_steps, env.steps_per_decision) == (8, 4)


def test_evaluation_counts_steps_of_the_environment():
    costs = [[1.0] * 10, [0.0] * 10]
    env = repeating(Priced(costs), 4)
    found = collect_episodes(
        env, lambda td: td.set("action", torch.zeros(2, 2)), 4, ["cost"], deterministic=True
    )
    assert found.lengths.tolist() == [10.0] * 4
    assert found.costs["cost"].tolist() == [10.0, 10.0, 0.0, 0.0]
    safety_gym = ENVIRONMENTS["safety_gym"]()
    assert repeating(ENVIRONMENTS["safety_gym"](), 3).highest_cost("cost") == 8.0
    assert safety_gym.highest_cost("cost") == 8.0


def test_schedules_and_budgets_before_it_go_by_single_steps():
    simmer = Simmer(
        {"cost": 4.0}, first=0.5, steps=16, discount=1.0, unsafe_reward=0.0, rescale_budgets=False
    )
    env = repeating(Priced([[1.0, 0.0] * 4]), 4, simmer)
    left = still(env, 5)["next", "observation"][0, :, -1]
    # 2 of 4, and 3 of 4 in the second episode, of which every step of cost takes a quarter
    assert left.tolist() == [0.0, -0.5, 0.25, -0.25, 0.5]
    env.continue_from(16)
    assert env.reset()["observation"][0, -1] == 1.0


def test_a_snapshot_goes_on_exactly_between_and_before_repeats():
    def make():
        config = {"robot_base": "point", "num_steps": 10}
        return repeating(make_env(config, num_envs=2, seed=0), 4, ObservedCosts(0.5), seed=0)

    env, other, action = make(), make(), torch.full((2, 2), 0.3)
    state = env.rollout(2, lambda td: td.set("action", action))[:, -1]["next"]
    kept = env.get_state()
    put = other.set_state(kept)
    assert torch.equal(put["observation"], state["observation"])
    assert torch.equal(put["steps_taken"], state["steps_taken"])
    steps = [one.step(one.set_state(kept).set("action", action))["next"] for one in (env, other)]
    assert (steps[0] == steps[1]).all()


def test_a_film_shows_repeats_in_the_time_of_the_environment():
    config = {"robot_base": "point", "num_steps": 40}
    env = make_env(config, num_envs=1, seed=0, transforms={"repeat": ActionRepeat(4)})
    manner = manner_of(env, "mp4")
    assert manner.steps_per_frame == 4
    assert manner.frames_per_second == pytest.approx(1 / (4 * env.seconds_per_step))
    assert manner_of(env, "gif").steps_per_frame == 4
    seen = []
    env.base_env.render = lambda **_: (
        seen.append(0) or torch.zeros(8, 8, 3, dtype=torch.uint8).numpy()
    )
    policy = lambda td: td.set("action", torch.zeros(1, 2))  # noqa: E731
    frames = list(record_episode(env, policy, ["cost"], deterministic=True, manner=manner))
    assert len(frames) == 11


def test_costs_and_their_traces_are_observed():
    env = transform_env(
        Priced([[1.0, 0.0, 4.0, 0.0]]), {"seen": ObservedCosts(0.5, ["cost"])}, evaluating=True
    )
    check_env_specs(env)
    assert env.observation_layout["last_costs"] == slice(4, 5)
    env.set_seed(0)
    seen = still(env, 6)["next", "observation"][0, :, 4:]
    assert seen.tolist() == [[1, 0.5], [0, 0.25], [4, 2.125], [0, 1.0625], [1, 0.5], [0, 0.25]]


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: ActionRepeat(0), "k=0 must be at least 1"),
        (lambda: ObservedCosts(1.0), r"decay=1 must be in \[0, 1\)"),
        (
            lambda: transform_env(
                Priced([[0.0]]), {"r": ActionRepeat(2), "o": ObservedCosts(0.5)}, evaluating=True
            ),
            r"'r' has to be the last one.*transforms=\[o,r\]",
        ),
        (
            lambda: transform_env(
                Priced([[0.0]]), {"o": ObservedCosts(0.5, ["coast"])}, evaluating=True
            ),
            "transforms.o: .*no such cost. Did you mean 'cost'",
        ),
        (
            lambda: (
                transform_env(
                    ENVIRONMENTS["dictionary"](), {"o": ObservedCosts(0.5)}, evaluating=True
                ).observation_spec
            ),
            "observed_costs adds columns",
        ),
    ],
)
def test_what_cannot_be_is_refused(make, words):
    with pytest.raises(ValueError, match=words):
        make()
