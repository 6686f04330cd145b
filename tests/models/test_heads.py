"""Heads: distributions for every kind of action, against torch's own and against numbers."""

from typing import get_args, get_type_hints

import pytest
import torch
from tensordict import TensorDict
from torch.distributions import Categorical
from torchrl.data import Binary, Bounded, MultiCategorical, OneHot
from torchrl.data import Categorical as CategoricalSpec
from torchrl.envs.utils import ExplorationType, set_exploration_type

from safe_rl.cli.config import Model
from safe_rl.models.heads import HEADS, make_head
from safe_rl.models.networks import assemble_actor, perceptron

BOUNDS = torch.tensor([[-1.0, 0.0], [2.0, 5.0]])
SPECS = {
    "gaussian": Bounded(*BOUNDS.unsqueeze(1).expand(2, 7, 2)),
    "categorical": CategoricalSpec(4, shape=(7,)),
    "components": MultiCategorical([3, 2], shape=(7, 2)),
    "alike": CategoricalSpec(3, shape=(7, 2)),
    "gymnasium": Bounded(torch.zeros(7, 2), torch.tensor([2, 1]).expand(7, 2), dtype=torch.int64),
    "one_hot": OneHot(4, shape=(7, 4), dtype=torch.int64),
}
KINDS = [(spec, "auto") for spec in SPECS] + [("gaussian", "tanh")]


def make_actor(spec, kind):
    head = make_head(kind, SPECS[spec], initial_log_std=-0.5)
    actor = assemble_actor(perceptron(3, head.num_outputs, [8], None, None), head)
    with torch.no_grad():
        for parameter in actor.parameters():
            parameter.add_(0.3 * torch.randn_like(parameter))
    return actor


def observations(number=7):
    return TensorDict(observation=torch.randn(number, 3), batch_size=[number])


@pytest.mark.parametrize(("spec", "kind"), KINDS)
def test_actions_are_those_of_the_environment(spec, kind):
    actor, batch = make_actor(spec, kind), observations()
    with torch.no_grad():
        sample = actor(batch)
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            best = actor(batch.clone())
    for action in (sample["action"], best["action"]):
        assert action.shape == SPECS[spec].shape
        if kind != "auto" or spec != "gaussian":  # the environment clips a Gaussian's
            assert SPECS[spec].is_in(action)
    assert sample["action_log_prob"].shape == (7,)
    found = actor.get_dist(batch).log_prob(sample["action"])
    torch.testing.assert_close(found, sample["action_log_prob"], rtol=1e-3, atol=1e-3)


def test_choices_that_there_are_not_are_never_taken():
    distribution = make_actor("components", "auto").get_dist(observations())
    assert distribution.sample((1000,))[..., 1].max() == 1
    logits = distribution.base_dist.logits
    expected = sum(
        Categorical(logits=logits[:, i, :choices]).entropy() for i, choices in enumerate((3, 2))
    )
    torch.testing.assert_close(distribution.entropy(), expected)
    gradients = torch.autograd.grad(distribution.entropy().sum(), logits)[0]
    assert gradients.isfinite().all()


@pytest.mark.parametrize(
    ("kind", "spec", "message"),
    [
        ("tanh", SPECS["categorical"], "model.head=tanh is not for.*auto or categorical"),
        ("categorical", SPECS["gaussian"], "auto or gaussian or tanh"),
        ("auto", Binary(3, shape=(7, 3)), "No policy can act in Binary"),
        ("auto", Bounded(-1, 1, (7,)), r"act in BoundedContinuous\[7\]"),
        ("auto", OneHot(4, shape=(7, 2, 4)), r"act in OneHot\[7, 2, 4\]"),
    ],
)
def test_heads_for_other_actions_are_refused(kind, spec, message):
    with pytest.raises(ValueError, match=message):
        make_head(kind, spec, initial_log_std=-0.5)


def test_the_command_line_knows_every_head():
    assert set(get_args(get_type_hints(Model)["head"])) == {"auto", *HEADS}
