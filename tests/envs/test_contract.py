"""An environment that lacks something of the contract is told what."""

import pytest
import torch
from point_mass import PointMass
from torchrl.data import Binary, Composite, Unbounded

from safe_rl.envs import ConstrainedEnv, ContractError, check_constrained_env

NUMBER, FLAG = Unbounded((2, 1)), Binary(1, shape=(2, 1), dtype=torch.bool)
DOUBLE = Composite(observation=Unbounded((2, 4), dtype=torch.float64), shape=(2,))
BROKEN = {
    "max_episode_steps": (None, "'max_episode_steps' must be.*got None"),
    "cost_keys": (None, "'cost_keys' must be a list of names with 'cost'"),
    "observation_layout": (
        {"place": slice(0, 99)},
        r"slice\(0, 99, None\) for 'place', beyond the",
    ),
    "observation_spec": (DOUBLE, "'observation' must be of float32.*float64"),
    "done_spec": (
        Composite(done=FLAG, terminated=FLAG.clone(), shape=(2,)),
        "its done spec must have 'truncated', got",
    ),
    "action_spec": (Unbounded((2, 2)), "continuous and bounded, or choices, got Unbounded"),
    "reward_spec": (
        Composite(reward=NUMBER, cost=NUMBER.clone(), shape=(2,)),
        r"reward spec must have 'cost_hazards' of the shape \(2, 1\), got {",
    ),
}


@pytest.mark.parametrize("name", BROKEN)
def test_what_is_missing_is_named(name):
    env, (value, message) = PointMass(2), BROKEN[name]
    setattr(env, name, value)
    with pytest.raises(ContractError, match=message):
        check_constrained_env(env)


@pytest.mark.parametrize(("cost", "shape"), [(None, "None"), (torch.zeros(2, 3), r"\[2, 3\]")])
def test_a_step_without_its_cost_or_with_another_shape_is_named(cost, shape):
    class Wrong(PointMass):
        def _step(self, tensordict):
            step = super()._step(tensordict)
            return step.exclude("cost") if cost is None else step.set("cost", cost)

    with pytest.raises(ContractError, match=rf"Wrong._step must write.*'cost': {shape}"):
        Wrong(2).rollout(1)


def test_an_environment_may_return_the_same_tensors_at_every_step():
    class Reusing(PointMass):
        def _step(self, tensordict):
            step = super()._step(tensordict)
            self.kept = step if not hasattr(self, "kept") else self.kept.update_(step)
            return self.kept.copy()

    fixed = lambda td: td.set("action", torch.full((2, 2), -0.5))  # noqa: E731
    plain, reused = (kind(2).rollout(5, fixed)["next"] for kind in (PointMass, Reusing))
    assert torch.equal(reused["observation"], plain["observation"])
    assert not torch.equal(plain["observation"][:, 0], plain["observation"][:, -1])


def test_other_kinds_are_told_what_to_be():
    with pytest.raises(ContractError, match="object is not derived from"):
        check_constrained_env(object())
    lacking = type("Lacking", (PointMass,), {"set_state": ConstrainedEnv.set_state})
    with pytest.raises(ContractError, match="it has 'get_state', so it needs 'set_state'"):
        check_constrained_env(lacking(2))
