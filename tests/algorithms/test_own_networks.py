"""Networks that ``model._target_`` builds."""

import pytest
import torch
from point_mass import PointMass
from point_mass_runs import point_mass_trainer
from run_configs import off_policy_config

from safe_rl.models import QEnsemble, make_actor, make_critic, make_squashed_actor
from safe_rl.training.building import build_trainer
from safe_rl.trust import TargetError, allow

TARGET = f"+model._target_={__name__}"


def tall(hidden_sizes, initial_log_std, observation_spec, num_costs, *, layers=1, **others):
    """Critics with more hidden layers than the policy."""
    size = observation_spec["observation"].shape[-1]
    widths = [*hidden_sizes] * layers
    networks = {
        "actor": make_actor(size, 2, hidden_sizes=hidden_sizes, initial_log_std=initial_log_std),
        "critic": make_critic(size, hidden_sizes=widths),
    }
    if num_costs:
        networks["cost_critic"] = make_critic(
            size, hidden_sizes=widths, out_key="cost_value", num_outputs=num_costs
        )
    return networks


def without_costs(observation_spec, **given):
    return tall(observation_spec=observation_spec, num_costs=0, **given)


def test_a_run_trains_the_networks_of_a_function(tmp_path):
    allow(__name__)
    own = ["algo=cpo", f"{TARGET}.tall", "+model.layers=3", "frames=320"]
    own += ["cost_limits={cost: 1, cost_north: 2}"]
    trainer = point_mass_trainer(tmp_path, *own, minibatch_size=None)
    networks = trainer.algorithm.networks
    assert set(networks) == {"actor", "critic", "cost_critic"}
    shapes = [tuple(p.shape) for p in networks["critic"].parameters() if p.ndim == 2]
    assert shapes[1:] == [(16, 16), (16, 16), (1, 16)]
    before = {name: next(network.parameters()).clone() for name, network in networks.items()}
    trainer.run()
    for name, network in networks.items():
        assert not torch.equal(before[name], next(network.parameters()))


def test_a_missing_network_is_named(tmp_path):
    allow(__name__)
    with pytest.raises(TargetError, match=r"without_costs must return .*; it lacks cost_critic\."):
        point_mass_trainer(tmp_path, "algo=cpo", f"{TARGET}.without_costs", minibatch_size=None)


def with_norm(hidden_sizes, observation_spec, action_spec, cost_outputs, **others):
    """Layer normalisation before an off-policy actor's layers, and one ensemble of three."""
    size, width = observation_spec["observation"].shape[-1], 12

    def encoder():
        return torch.nn.Sequential(torch.nn.Linear(size, width), torch.nn.LayerNorm(width))

    low, high = action_spec.low, action_spec.high
    critics = {"hidden_sizes": hidden_sizes, "num_networks": 3}
    return {
        "actor": make_squashed_actor(
            width, low, high, hidden_sizes=hidden_sizes, encoder=encoder()
        ),
        "critic": QEnsemble(width, len(low), encoder=encoder(), **critics),
        "cost_critic": QEnsemble(
            size,
            len(low),
            num_outputs=cost_outputs,
            out_key="cost_state_action_value",
            **critics,
        ),
    }


def test_an_off_policy_run_trains_the_networks_of_a_function(tmp_path):
    allow(__name__)
    config = off_policy_config("algo=sac_lagrangian", f"{TARGET}.with_norm", "frames=480")
    trainer = build_trainer(config, PointMass(4), tmp_path)
    networks = trainer.algorithm.networks
    before = {name: [p.clone() for p in net.parameters()] for name, net in networks.items()}
    assert networks["cost_critic"].num_networks == 3
    trainer.run()
    for name, network in networks.items():
        pairs = zip(before[name], network.parameters(), strict=True)
        assert not any(torch.equal(old, new) for old, new in pairs), name
