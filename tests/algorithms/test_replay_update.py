"""Updates from a memory: targets that follow, and checkpoints that lack nothing."""

from copy import deepcopy
from functools import partial

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded

from safe_rl.algorithms import Memory, PolicyUpdate, ReplayUpdate
from safe_rl.models import QEnsemble, make_squashed_actor
from safe_rl.objectives import SACLoss


def make_update(seed, tau=0.1, **keys):
    torch.manual_seed(seed)
    spec = Bounded(-1, 1, [2])
    loss = SACLoss(
        make_squashed_actor(3, spec.low, spec.high, hidden_sizes=[8]),
        QEnsemble(3, 2, hidden_sizes=[8], num_networks=2),
        action_spec=spec,
        gamma=0.9,
        alpha_init=0.1,
    )
    optimizer = partial(torch.optim.Adam, lr=0.01)
    return ReplayUpdate(loss, optimizer=optimizer, updates_per_step=0.5, tau=tau, **keys)


@pytest.fixture
def memory():
    generator = torch.Generator().manual_seed(0)
    memory = Memory(
        capacity=100, batch_size=16, in_keys=make_update(0).loss.in_keys, reward_keys=["reward"],
        reward_gamma=0.9, n_steps=1, keep=False,
    )  # fmt: skip
    flags = torch.zeros(2, 40, 1, dtype=torch.bool)
    following = {"observation": torch.randn(2, 40, 3, generator=generator), "done": flags}
    following |= {"terminated": flags, "reward": torch.randn(2, 40, 1, generator=generator)}
    memory.extend(
        TensorDict(
            observation=torch.randn(2, 40, 3, generator=generator),
            action=torch.rand(2, 40, 2, generator=generator),
            next=following,
            batch_size=[2, 40],
        )
    )
    return memory


def networks(update):
    """Trained and target parameters of the Q functions, by name."""
    trained = update.loss.qvalue_network_params.flatten_keys(".")
    target = update.loss.target_qvalue_network_params.flatten_keys(".")
    return {name: (value.detach().clone(), target[name].clone()) for name, value in trained.items()}


def test_targets_go_a_tenth_of_the_way_to_where_the_networks_have_gone(memory):
    update = make_update(0)
    before = networks(update)
    update(memory, 1)
    for name, (trained, target) in networks(update).items():
        start = before[name][1]
        torch.testing.assert_close(target, start + 0.1 * (trained - start))
        assert not trained.equal(before[name][0])


def test_a_loaded_update_goes_on_as_the_saved_one(memory):
    saved, loaded = make_update(0), make_update(1)
    saved(memory, 6)
    loaded.load_state_dict(deepcopy(saved.state_dict()))
    for update in (saved, loaded):
        torch.manual_seed(2)
        update(memory, 6)
    for (name, (trained, target)), others in zip(
        networks(saved).items(), networks(loaded).values(), strict=True
    ):
        assert trained.equal(others[0]), name
        assert target.equal(others[1]), name


def test_a_checkpoint_of_before_the_first_update_is_whole(memory):
    fresh, trained = make_update(0).state_dict(), make_update(1)
    trained(memory, 2)
    # TorchRL makes this constant of the action spec when a loss is first computed
    assert set(trained.state_dict()["loss"]) - set(fresh["loss"]) <= {"_target_entropy"}
    trained.load_state_dict(fresh)
    assert trained.loss.alpha_init.equal(make_update(0).loss.alpha_init)


def test_targets_that_would_never_move_and_other_losses_are_refused():
    with pytest.raises(ValueError, match="tau is null, but SACLoss has target networks"):
        make_update(0, tau=None)
    with pytest.raises(TypeError, match=r"Linear is no loss on a replay buffer.*ReplayLoss"):
        ReplayUpdate(torch.nn.Linear(1, 1), optimizer=torch.optim.Adam, updates_per_step=1, tau=0.1)


def test_rates_are_those_of_the_longest_beginning_and_wrong_ones_are_told_the_nearest():
    rates = {"qvalue_network_params": 0.1, "qvalue_network_params.network.weights": 0.2}
    groups = make_update(0, rates=rates).optimizer.param_groups
    assert [(group["lr"], len(group["params"])) for group in groups] == [
        (0.01, 5),
        (0.1, 2),
        (0.2, 2),
    ]
    with pytest.raises(ValueError, match=r"names 'alpha', but .* Did you mean 'log_alpha'"):
        make_update(0, rates={"alpha": 1e-4})


def test_constructors_are_checked_unless_an_annotation_cannot_be_read():
    with pytest.raises(ValueError, match=r"tau=0.7: it must be a number above 0 and at most 0\.5"):
        make_update(0, tau=0.7)

    class Own(PolicyUpdate):
        def __init__(self, loss: "OnlyForTypeCheckers", *, size: int):  # noqa: F821
            self.size = size

        def __call__(self, batch, cost_violation, episode_length):
            return {}

    assert Own(None, size=3).size == 3
