"""Networks by configuration: encoders of every observation, and memories."""

import pytest
import torch
from gymnasium_envs import Recall  # noqa: F401, registers Recall-v0
from tensordict import TensorDict
from torch import nn
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs.utils import check_env_specs

from safe_rl.collectors import make_collector
from safe_rl.envs import make_env
from safe_rl.models import build_networks

CPU = torch.device("cpu")
ENCODERS = {"vector": [5], "channels": [4, 6], "kernels": [4, 3], "strides": [2, 1]}
MODEL = {"hidden_sizes": [8], "initial_log_std": -0.5, "input_scale": {}}
ACTIONS = Bounded(-1, 1, (3, 2))


def spec(**entries):
    return Composite(observation=Composite(entries, shape=(3,)), shape=(3,))


def build(observation_spec, num_costs=2, layout=None, **model):
    return build_networks(
        MODEL | model, observation_spec, ACTIONS, layout or {}, num_costs=num_costs, device=CPU
    )


def test_one_vector_needs_no_encoder():
    flat = Composite(observation=Unbounded((3, 7)), shape=(3,))
    networks = build(flat)
    assert [tuple(p.shape) for p in networks["critic"].parameters()] == [(8, 7), (8,), (1, 8), (1,)]
    with pytest.raises(ValueError, match=r"gyro \[3\], sight \[9, 9, 3\].*use model=cnn"):
        build(spec(gyro=Unbounded((3, 3)), sight=Unbounded((3, 9, 9, 3))))
    with pytest.raises(ValueError, match=r"gyro \[3\], lidar \[9\].*use model=dict"):
        build(spec(gyro=Unbounded((3, 3)), lidar=Unbounded((3, 9))))
    with pytest.raises(ValueError, match=r"model=cnn encodes pictures.* Use model=mlp"):
        build(flat, encoders={**ENCODERS, "vector": []})


def test_every_entry_has_its_encoder():
    observed = spec(gyro=Unbounded((3, 3)), sight=Unbounded((3, 12, 15, 3)))
    networks = build(observed, encoders=ENCODERS, input_scale={"gyro": 0.5})
    batch = observed.zero()
    batch["observation", "gyro"] = torch.randn(3, 3)
    batch["observation", "sight"] = torch.rand(3, 12, 15, 3)
    value = networks["cost_critic"](batch)["cost_value"]
    assert value.shape == (3, 2)
    # by hand: tanh of a scaled vector, convolutions of colours first, a tanh perceptron
    gyro, sight = networks["cost_critic"].module.encoders
    convolutions = [layer for layer in sight.modules() if isinstance(layer, nn.Conv2d)]
    linear = next(layer for layer in gyro.modules() if isinstance(layer, nn.Linear))
    picture = batch["observation", "sight"].permute(0, 3, 1, 2)
    for layer in convolutions:
        picture = nn.functional.conv2d(picture, layer.weight, layer.bias, layer.stride).relu()
    codes = torch.cat(
        [torch.tanh(linear(0.5 * batch["observation", "gyro"])), picture.flatten(1)], 1
    )
    first, last = (x for x in networks["cost_critic"].module.perceptron if isinstance(x, nn.Linear))
    torch.testing.assert_close(value, last(torch.tanh(first(codes))))


def test_entries_are_scaled_by_their_names():
    """Gymnasium's goals stand beside an entry that is called `observation`."""
    sizes = {"desired_goal": 2, "observation": 3}
    observed = spec(**{name: Unbounded((3, size)) for name, size in sizes.items()})
    layout = {"desired_goal": slice(0, 2), "observation": slice(2, 5)}
    scales = {"desired_goal": 0.5, "observation": 0.1}
    critic = build(observed, layout=layout, encoders=ENCODERS, input_scale=scales)["critic"]
    for encoder, (name, size) in zip(critic.module.encoders, sizes.items(), strict=True):
        assert encoder[0].scale.tolist() == pytest.approx([scales[name]] * size)
    assert critic(observed.rand())["state_value"].shape == (3, 1)


def test_frames_that_are_stacked_are_scaled_alike():
    """The layout has the columns of one frame; TorchRL's `CatFrames` puts several in a row."""
    observed = Composite(observation=Unbounded((3, 10)), shape=(3,))
    layout = {"gyro": slice(0, 2), "lidar": slice(2, 5)}
    critic = build(observed, layout=layout, input_scale={"gyro": 0.5})["critic"]
    assert critic.module[0].scale.tolist() == 2 * [0.5, 0.5, 1.0, 1.0, 1.0]
    assert critic(observed.rand())["state_value"].shape == (3, 1)


def value_of(picture, kind=Unbounded, **limits):
    """What the same new critic says of pictures."""
    seen = kind(**limits, shape=picture.shape, dtype=picture.dtype)
    torch.manual_seed(0)
    critic = build(Composite(observation=seen, shape=(3,)), encoders=ENCODERS)["critic"]
    return critic(TensorDict(observation=picture, batch_size=[3]))["state_value"]


def test_pictures_may_be_bytes_and_have_their_colours_first():
    picture = torch.randint(256, (3, 12, 15, 3), dtype=torch.uint8)
    expected = value_of(picture.float() / 255)
    for changed in (picture, picture.permute(0, 3, 1, 2)):
        torch.testing.assert_close(value_of(changed), expected)


@pytest.mark.parametrize(
    ("shape", "number"),
    [((12, 15, 3), 3), ((4, 12, 15), 4), ((12, 12, 9), 9), ((9, 12, 12), 9), ((15, 12, 9), 9),
     ((64, 8, 8), 64), ((9, 15, 12), 9)],
)  # fmt: skip
def test_colours_or_pictures_in_a_row_are_at_either_end(shape, number):
    observed = Composite(observation=Unbounded((3, *shape)), shape=(3,))
    critic = build(observed, encoders=ENCODERS)["critic"]
    first = next(module for module in critic.modules() if isinstance(module, nn.Conv2d))
    assert first.in_channels == number


def test_a_picture_of_few_integers_is_scaled_by_the_largest():
    """Planes of 0 and 1, as of a board, would nearly vanish beside bytes."""
    plane = torch.randint(2, (3, 8, 8, 1), dtype=torch.uint8)
    found = [value_of(most * plane, Bounded, low=0, high=most) for most in (1, 255)]
    torch.testing.assert_close(*found)


@pytest.mark.parametrize(
    ("observed", "model", "message"),
    [
        (
            spec(sight=Unbounded((3, 5, 5, 3))),
            {"encoders": {**ENCODERS, "kernels": [9, 3]}},
            "'sight'.*too small.*kernels",
        ),
        (spec(odd=Unbounded((3, 5, 5))), {"encoders": ENCODERS}, r"'odd'.*the shape \[5, 5\]"),
        (spec(gyro=Unbounded((3, 3))), {"memory": {"size": 4}}, "choose model=gru"),
    ],
)
def test_what_does_not_fit_is_said(observed, model, message):
    with pytest.raises(ValueError, match=message):
        build(observed, **model)


RECALL = {"_target_": "safe_rl.envs.gymnasium.make_gymnasium", "id": "Recall-v0", "num_steps": 5}
MEMORY = {"memory": {"_target_": "safe_rl.envs.transforms.RecurrentState", "size": 4}}


def remembering(num_envs=3, frames=36):
    """A recurrent policy's networks, and its second batch: episodes of 5 in rows of 12 steps."""
    env = make_env(RECALL, num_envs=num_envs, seed=0, transforms=MEMORY)
    networks = build_networks(
        {**MODEL, "memory": {"size": 4}, "normalise": 10.0},
        env.observation_spec, env.action_spec, env.observation_layout, num_costs=1, device=CPU,
    )  # fmt: skip
    with torch.no_grad():
        for parameter in networks["actor"].parameters():
            parameter.mul_(3)  # so that what is remembered makes a difference
    batches = iter(make_collector(env, networks["actor"], frames_per_batch=frames))
    next(batches)
    return networks, next(batches).clone()


def test_an_environment_with_a_memory_keeps_its_specs():
    check_env_specs(make_env(RECALL, num_envs=3, seed=0, transforms=MEMORY))
    check_env_specs(make_env("PointGoal1", num_envs=2, seed=0, transforms=MEMORY))


def test_sequences_say_of_actions_what_was_said_when_they_were_taken():
    networks, batch = remembering()
    assert batch["is_init"].sum() == 3 * 2  # steps 3 and 8 of the second batch
    for rows in (batch, batch[torch.tensor([2, 0])]):
        distribution = networks["actor"].get_dist(rows.select(*networks["actor"].in_keys))
        torch.testing.assert_close(distribution.log_prob(rows["action"]), rows["action_log_prob"])


def test_memories_are_those_of_a_loop_over_steps():
    networks, batch = remembering()
    encode, memory = networks["actor"].module[0], networks["actor"].module[1]
    weights = dict(memory.recurrent.gru.named_parameters())
    cell = nn.GRUCell(8, 4)
    cell.load_state_dict({name.removesuffix("_l0"): value for name, value in weights.items()})
    features = encode(batch.select("observation"))["features"]
    state = batch["memory"][:, 0]
    assert state.any()
    for step in range(batch.shape[1]):
        state = torch.where(batch["is_init"][:, step], 0.0, state)
        torch.testing.assert_close(batch["memory"][:, step], state)
        state = cell(features[:, step], state)
        torch.testing.assert_close(batch["next", "memory"][:, step], state)
