"""Updates from a memory: targets that follow, and checkpoints that lack nothing.

Updates of any kind that are copied or stored, as processes and searches do, train their own
networks.
"""

import pickle
from copy import deepcopy
from functools import partial

import pytest
import torch
from samples import TRUST_REGION
from tensordict import TensorDict
from torchrl.data import Bounded
from torchrl.objectives import ValueEstimators

from safe_rl.algorithms import Memory, MinibatchUpdate, PolicyUpdate, ReplayUpdate, TRPOStep
from safe_rl.models import QEnsemble, make_actor, make_bounded_actor, make_squashed_actor
from safe_rl.objectives import BCLoss, PPOLoss, SACLoss, TD3Loss, TRPOLoss

ADAM = partial(torch.optim.Adam, lr=0.01)


def make_update(seed, tau=0.1, **keys):
    torch.manual_seed(seed)
    spec = Bounded(-1, 1, [2])
    loss = SACLoss(
        make_squashed_actor(3, spec.low, spec.high, hidden_sizes=[8]),
        QEnsemble(3, 2, hidden_sizes=[8], num_networks=2),
        **{"action_spec": spec, "gamma": 0.9, "alpha_init": 0.1},
    )
    return ReplayUpdate(loss, optimizer=ADAM, updates_per_step=0.5, tau=tau, **keys)


def make_td3(device="cpu", kind=TD3Loss, gamma=0.9, **keys):
    """A TD3 update without noise, so that nothing in its steps is random."""
    torch.manual_seed(0)
    spec = Bounded(-1, 1, [2])
    loss = kind(
        make_bounded_actor(3, spec.low, spec.high, hidden_sizes=[8]),
        QEnsemble(3, 2, hidden_sizes=[8], num_networks=2),
        **{"action_spec": spec, "gamma": gamma, "policy_noise": 0.0, "noise_clip": 0.5},
    ).to(device)
    return ReplayUpdate(loss, optimizer=ADAM, updates_per_step=1, tau=0.1, **keys)


def fill(**keys):
    draw = partial(torch.randn, 2, 40, generator=torch.Generator().manual_seed(0))
    memory = Memory(
        capacity=100, batch_size=16, in_keys=make_update(0).loss.in_keys, summed=["reward"],
        gamma=0.9, n_steps=1, keep=False, **keys,
    )  # fmt: skip
    flags = torch.zeros(2, 40, 1, dtype=torch.bool)
    following = {"observation": draw(3), "done": flags, "terminated": flags, "reward": draw(1)}
    here = {"observation": draw(3), "action": draw(2).tanh()}
    memory.extend(TensorDict({**here, "next": following}, [2, 40]))
    return memory


@pytest.fixture(name="memory")
def filled():
    return fill()


def networks(update):
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


def test_an_update_that_is_resumed_discounts_as_it_is_told(memory):
    before, resumed = make_td3(), make_td3(gamma=0.1)
    resumed.load_state_dict(before.state_dict())
    before.loss.make_value_estimator(ValueEstimators.TD0, gamma=0.1)
    steps = next(memory.minibatches(1))
    losses = [each.loss.critic_losses(steps.clone())["loss_qvalue"] for each in (resumed, before)]
    torch.testing.assert_close(*losses)


def test_a_checkpoint_of_before_the_first_update_is_whole(memory):
    fresh, trained = make_update(0).state_dict(), make_update(1)
    trained(memory, 2)
    # TorchRL makes this constant of the action spec when a loss is first computed
    assert set(trained.state_dict()["loss"]) - set(fresh["loss"]) <= {"_target_entropy"}
    trained.load_state_dict(fresh)
    assert trained.loss.alpha_init.equal(make_update(0).loss.alpha_init)


def test_targets_that_would_never_move_and_other_losses_are_refused():
    with pytest.raises(ValueError, match="tau=None: SACLoss has target networks"):
        make_update(0, tau=None)
    cloning = BCLoss(make_bounded_actor(3, -torch.ones(2), torch.ones(2), hidden_sizes=[8]))
    with pytest.raises(ValueError, match="BCLoss has no target networks: set it to null"):
        ReplayUpdate(cloning, optimizer=torch.optim.Adam, updates_per_step=1, tau=0.1)
    with pytest.raises(TypeError, match=r"Linear is no loss on a replay buffer.*ReplayLoss"):
        ReplayUpdate(torch.nn.Linear(1, 1), optimizer=torch.optim.Adam, updates_per_step=1, tau=0.1)


def test_rates_are_those_of_the_longest_beginning_and_wrong_ones_are_told_the_nearest():
    rates = {"qvalue_network_params": 0.1, "qvalue_network_params.network.weights": 0.2}
    groups = make_update(0, rates=rates).optimizer.param_groups
    found = [(group["lr"], len(group["params"])) for group in groups]
    assert found == [(0.01, 5), (0.1, 2), (0.2, 2)]
    with pytest.raises(ValueError, match=r"names 'alpha', but .* Did you mean 'log_alpha'"):
        make_update(0, rates={"alpha": 1e-4})


def test_constructors_are_checked_unless_an_annotation_cannot_be_read():
    with pytest.raises(ValueError, match=r"tau=0.7: it must be less than or equal to 0\.5"):
        make_update(0, tau=0.7)

    class Own(PolicyUpdate):
        def __init__(self, loss: "OnlyForTypeCheckers", *, size: int):  # noqa: F821
            self.size = size

        def __call__(self, batch, limits):
            return {}

    assert Own(None, size=3).size == 3


CHANGES = {"copied": deepcopy, "stored": lambda x: pickle.loads(pickle.dumps(x))}


def make_policy():
    torch.manual_seed(0)
    actor = make_actor(3, 2, hidden_sizes=[8], initial_log_std=-0.5)
    with torch.no_grad():
        batch = actor(TensorDict(observation=torch.randn(16, 3), batch_size=[16]))
    return actor, batch.set("advantage", torch.randn(16, 1))


def make_minibatch_update():
    actor, batch = make_policy()
    loss = PPOLoss(actor, clip_epsilon=0.2, entropy_coeff=0.01)
    update = MinibatchUpdate(loss, optimizer=ADAM, num_passes=3, minibatch_size=None)
    return update, lambda update: update(batch.clone())


def make_trpo_step():
    actor, batch = make_policy()
    step = TRPOStep(TRPOLoss(actor, entropy_coeff=0.01), **TRUST_REGION)
    return step, lambda step: step(batch.clone())


def make_replay_update():
    def take(update):
        torch.manual_seed(1)
        update(fill(), 4)

    return make_td3(), take


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize("make", [make_minibatch_update, make_trpo_step, make_replay_update])
def test_a_copy_trains_its_networks_and_no_others(make, change):
    update, take = make()
    take(update)  # so that an optimiser has moments
    other = CHANGES[change](update)
    before = TensorDict.from_module(update.loss).data.clone()
    take(other)
    assert (TensorDict.from_module(update.loss).data == before).all()
    take(update)
    after, copied = (TensorDict.from_module(part.loss).data for part in (update, other))
    assert (after == copied).all()
    changed = {key[0] for key, value in after.items(True, True) if (value != before[key]).any()}
    expected = {"actor_network_params"}
    if make is make_replay_update:
        expected |= {"qvalue_network_params", "target_qvalue_network_params"}
    assert expected <= changed
    for key, tensor in TensorDict.from_module(other.loss.actor_network).data.items(True, True):
        assert (tensor == copied["actor_network_params", *key]).all()


def test_an_optimiser_that_is_copied_before_its_loss_trains_it():
    actor, batch = make_policy()
    loss = PPOLoss(actor, clip_epsilon=0.2, entropy_coeff=0.0)
    optimizer, copied = deepcopy([ADAM(loss.parameters()), loss])
    copied(batch)["loss_objective"].backward()
    optimizer.step()
    own, new = (TensorDict.from_module(part).data for part in (loss, copied))
    assert any((new[key] != value).any() for key, value in own.items(True, True))


@pytest.mark.gpu
@pytest.mark.parametrize("keys", [{"max_grad_norm": 1.0}, {"policy_delay": 2}])
def test_cuda_graphs_take_the_steps_of_python_also_after_a_checkpoint(keys):
    found = []
    for cuda_graph in (False, True):
        update = make_td3("cuda", cuda_graph=cuda_graph, **keys)
        memory = fill(device="cuda")
        torch.manual_seed(1)
        for number in (1, 20, 20):
            row = update(memory, number)
            update.load_state_dict(deepcopy(update.state_dict()))
        found.append((row, networks(update)))
    torch.testing.assert_close(found[1], found[0], rtol=1e-3, atol=1e-5)


@pytest.mark.gpu
def test_cuda_graphs_tell_of_losses_that_diverge_and_of_those_that_cannot_be_recorded():
    class OnHost(TD3Loss):
        def actor_losses(self, tensordict):
            losses = super().actor_losses(tensordict)
            return losses.set("qvalue", torch.tensor(losses["qvalue"].item(), device="cuda"))

    memory = fill(device="cuda")
    assert make_td3("cuda", OnHost, cuda_graph=False)(memory, 5)["qvalue"].isfinite()
    update = make_td3("cuda")
    update(memory, 5)
    update.loss.qvalue_network_params.data.apply_(lambda tensor: tensor.fill_(torch.nan))
    with pytest.raises(FloatingPointError, match="'loss_qvalue' is nan"):
        update(memory, 5)
    # last, because a failed recording can break what follows
    with pytest.raises(RuntimeError) as failed:
        make_td3("cuda", OnHost)(memory, 5)
    assert "policy_update.cuda_graph=false" in failed.value.__notes__[0]
