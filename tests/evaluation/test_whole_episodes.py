"""Which episodes are counted, on an environment whose lengths are known; layouts by counting."""

import itertools
from inspect import Signature
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from point_mass import PointMass
from torchrl.envs import DeviceCastTransform, TransformedEnv

from safe_rl.envs import make_env
from safe_rl.envs.transforms import transform_env
from safe_rl.evaluation import video
from safe_rl.evaluation.episodes import (
    collect_episodes,
    default_seed,
    periodic_evaluation,
    shared_layouts,
)
from safe_rl.evaluation.video import FORMATS, check_camera, record_episode
from safe_rl.models import BehaviourPolicy, make_actor

# steps of every world's episodes, in turn
LENGTHS = [[30, 1], [2, 3], [1, 1]]
FILM = {"deterministic": True, "form": FORMATS["mp4"]}


def small_policy():
    return BehaviourPolicy(make_actor(4, 2, hidden_sizes=[4], initial_log_std=0.0))


class KnownLengths(PointMass):
    """The reward of a step is 1, its cost 0.5."""

    def __init__(self, lengths=LENGTHS):
        self._lengths = torch.tensor(lengths)
        super().__init__(len(lengths), self._lengths.max().item())

    def _reset(self, tensordict=None, **kwargs):  # its tensors stay on the CPU
        return super()._reset(None if tensordict is None else tensordict.cpu(), **kwargs)

    def _step(self, tensordict):
        step = super()._step(tensordict)
        over = self._step_count >= self._lengths.gather(1, (self._episode.long() - 1) % 2)
        ends = {"done": over, "terminated": over.clone(), "truncated": over & False}
        return step.update({"reward": over * 0.0 + 1, "cost": over * 0.0 + 0.5, **ends})


@pytest.mark.parametrize(
    ("number", "expected"),
    [
        (3, [30, 2, 1]),
        (5, [30, 1, 2, 3, 1]),  # the first two worlds have one more
        (6, [30, 1, 2, 3, 1, 1]),
    ],
)
def test_every_world_contributes_its_first_episodes(number, expected):
    policy = small_policy()
    episodes = collect_episodes(KnownLengths(), policy, number, ["cost"], deterministic=False)
    assert episodes.lengths.tolist() == expected
    assert episodes.returns.tolist() == expected
    assert episodes.costs["cost"].tolist() == [0.5 * length for length in expected]


@pytest.mark.parametrize("keys", itertools.permutations(["cost", "cost_hazards", "cost_boundary"]))
def test_costs_keep_their_names_in_any_order(keys):
    changes = {"num_steps": 20, "hazards_size": 2.0, "constrain_boundary": True}
    changes |= {"boundary_x": 0.001, "constrain_indicator": False}
    env = make_env("PointGoal1", num_envs=1, seed=0, **changes)
    sums = dict.fromkeys(keys, 0.0)

    def add(step):
        for key in keys:
            sums[key] += step["next", key].item()

    policy = BehaviourPolicy(make_actor(60, 2, hidden_sizes=[4], initial_log_std=0.0))
    episodes = collect_episodes(env, policy, 1, keys, deterministic=True, record=add)
    assert {key: costs.item() for key, costs in episodes.costs.items()} == pytest.approx(sums)
    assert len(set(sums.values())) == 3


class Shaped(KnownLengths):
    """Learning sees another reward than the one that returns are made of."""

    return_key = "score"

    def __init__(self, lengths):
        super().__init__(lengths)
        self.full_reward_spec["score"] = self.full_reward_spec["reward"].clone()

    def _step(self, tensordict):
        step = super()._step(tensordict)
        return step.update({"score": step["reward"], "reward": 10 * step["reward"]})

    def render(self):
        return np.zeros((40, 300, 3), np.uint8)


def test_returns_are_of_the_entry_that_the_environment_names(monkeypatch):
    def make():
        return transform_env(Shaped([[2, 2]]), {}, evaluating=True)

    policy = small_policy()
    episodes = collect_episodes(make(), policy, 2, ["cost"], deterministic=True)
    assert make().return_key == "score"
    assert episodes.returns.tolist() == [2.0, 2.0]
    shown = []
    monkeypatch.setattr(video, "_frame", lambda *given: shown.append(given[1:]))
    list(record_episode(make(), policy, **FILM))
    assert shown == [(0, 0.0, 0.0), (2, 2.0, 1.0)]


class Drawn(KnownLengths):
    """One world whose pictures are of one kind and size: the number of the step in grey."""

    def __init__(self):
        super().__init__([[6, 6]])

    def render(self):
        return np.full((50, 70, 3), 10 * int(self._step_count), np.uint8)


def test_a_film_takes_the_pictures_that_an_environment_has():
    env, policy = Drawn(), small_policy()
    check_camera(env, "free")
    frames = list(record_episode(env, policy, **FILM))
    # every other step of six, and the end; what the encoder cannot halve twice is cut off
    assert [frame[0, 0, 0] for frame in frames] == [0, 20, 40, 60]
    # beside the narrow picture there is room for what stands below it
    assert {frame.shape for frame in frames} == {(48 + 20, 280, 3)}
    assert {int(frame[:48, 68:].min()) for frame in frames} == {255}
    assert len({frame[48:].tobytes() for frame in frames}) == 4


@pytest.mark.parametrize("shape", [(50, 70), (1, 50, 70, 3), (50, 70, 4)])
def test_a_film_takes_grey_pictures_batches_and_fourth_channels(shape):
    env, policy = Drawn(), small_policy()
    env.render = lambda: np.full(shape, 200, np.uint8)
    check_camera(env, "free")
    frames = list(record_episode(env, policy, **FILM))
    assert {(frame.shape, int(frame[0, 0, 0])) for frame in frames} == {((68, 280, 3), 200)}


def test_what_prevents_a_film_is_said_before_any_episode():
    with pytest.raises(ValueError, match="camera=track: this environment has no cameras"):
        check_camera(Drawn(), "track")
    env = KnownLengths([[1, 1]])
    env.render = None
    with pytest.raises(ValueError, match="draws no pictures"):
        check_camera(env, "free")
    for nothing in (None, [None]):  # as Gymnasium's without a mode, and batches of them
        env.render = Mock(return_value=nothing, __signature__=Signature())
        with pytest.raises(ValueError, match=r"picture=…: .* draws no .* render_mode=rgb_array"):
            check_camera(env, "free", "gif")
    for error, words in ((RuntimeError("no\nscreen"), "no screen"), (KeyError(), "KeyError")):
        env.render = Mock(side_effect=error, __signature__=Signature())
        with pytest.raises(ValueError, match=f"video=true: .* cannot be drawn: {words}"):
            check_camera(env, "free")


FIXED = {"randomize_layout": False, "layout_seeds": None, "layout_seeds_first": 0}
UNLIMITED = {**FIXED, "randomize_layout": True}


@pytest.mark.parametrize(
    ("trained", "evaluated"), list(itertools.product([(0, 5), (3, 4), (9, 1)], repeat=2))
)
def test_shared_layouts_are_those_in_both_ranges(trained, evaluated):
    envs = [
        {**UNLIMITED, "layout_seeds_first": first, "layout_seeds": number}
        for first, number in (trained, evaluated)
    ]
    met, shown = (set(range(first, first + number)) for first, number in (trained, evaluated))
    assert shared_layouts(*envs, same_seed=False) == len(met & shown) / len(shown)


def test_layouts_without_a_range_are_known_where_they_are_fixed_and_the_seed_is_trainings():
    assert default_seed(FIXED, 4) == 4
    assert default_seed(UNLIMITED, 4) != 4
    assert default_seed({}, 4) != 4
    for trained, evaluated, same_seed, share in (
        (FIXED, FIXED, True, 1.0),
        (FIXED, FIXED, False, 0.0),
        (UNLIMITED, UNLIMITED, False, 0.0),
        (UNLIMITED, FIXED, True, 0.0),
        ({}, {}, False, 0.0),
        ({"layout_seeds": 5}, {"layout_seeds": 10}, False, 0.5),
    ):
        assert shared_layouts(trained, evaluated, same_seed=same_seed) == share


def make_evaluation(make, device="cpu", **keys):
    actor = make_actor(4, 2, hidden_sizes=[4], initial_log_std=-0.5, device=device)
    policy = BehaviourPolicy(actor)
    return periodic_evaluation(make, policy, ["cost"], interval=100, episodes=3, seed=7, **keys)


@pytest.mark.parametrize(("fixed", "seeds"), [(True, [7, 7]), (False, [107, 207])])
def test_evaluations_in_between_keep_to_a_fixed_layout(fixed, seeds):
    make = Mock(side_effect=lambda *, num_envs, seed: KnownLengths([[2, 2]] * num_envs))
    evaluate = make_evaluation(make, fixed_layout=fixed)
    assert [evaluate(after - 100, after)["evaluation_cost"] for after in (100, 200)] == [1.0, 1.0]
    assert [call.kwargs["seed"] for call in make.call_args_list] == seeds


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def test_evaluations_in_between_leave_the_draws_of_training_alone_whatever_seeding_does(device):
    class Seeding(KnownLengths):  # as TorchRL's tutorials have it: torch's generator is seeded
        def _set_seed(self, seed):
            torch.manual_seed(seed)

    def make(*, num_envs, seed):
        env = Seeding([[2, 2]] * num_envs)
        env.set_seed(seed)
        return TransformedEnv(env, DeviceCastTransform(device, orig_device="cpu"))

    evaluate = make_evaluation(make, device=device, fixed_layout=False)
    state = torch.cuda.get_rng_state if device == "cuda" else torch.get_rng_state
    before = state()
    assert evaluate(0, 100)["evaluation_cost"] == 1.0
    assert torch.equal(state(), before)
