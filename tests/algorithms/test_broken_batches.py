"""A number that is none stops the whole algorithm before any of its parameters has changed."""

import pytest
import torch
from point_mass import PointMass
from run_configs import point_mass_config

from safe_rl.algorithms import OnPolicy
from safe_rl.collectors import EpisodeAccounting, make_collector


@pytest.mark.parametrize("algo", ["ppo_lagrangian", "cpo"])
@pytest.mark.parametrize("entry", [("next", "reward"), ("next", "cost"), "observation"])
def test_nothing_is_learnt_from_it(algo, entry):
    minibatch = None if algo == "cpo" else 40
    config = point_mass_config(f"algo={algo}", "num_threads=1", minibatch_size=minibatch)
    env = PointMass(4, 20, 0)
    algorithm = OnPolicy.build(config, env)
    collector = make_collector(env, algorithm.policy, frames_per_batch=160)
    batch = next(iter(collector))
    episodes = EpisodeAccounting(4, ["cost"]).update(batch)
    batch[entry][1, 7, 0] = torch.nan
    before = {
        name: value.clone()
        for part, network in algorithm.networks.items()
        for name, value in network.state_dict(prefix=f"{part}.").items()
    }
    with pytest.raises(FloatingPointError) as error:
        algorithm.learn(batch, episodes)
    assert str(error.value).startswith(f"{entry!r} is not finite in 1 of 160 samples")
    for part, network in algorithm.networks.items():
        for name, value in network.state_dict(prefix=f"{part}.").items():
            assert torch.equal(value, before[name])
    collector.shutdown()
