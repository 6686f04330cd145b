"""Policies of every kind of distribution, small ones, and batches of what they do."""

import functools

import torch
from samples import NUM_OBS
from tensordict import TensorDict
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import nn
from torch.distributions import (
    AffineTransform,
    Beta,
    Categorical,
    Distribution,
    Independent,
    Normal,
    TransformedDistribution,
)
from torchrl.envs.utils import ExplorationType
from torchrl.modules import IndependentNormal, OneHotCategorical, ProbabilisticActor, TanhNormal
from torchrl.modules import TruncatedNormal as TorchRLTruncatedNormal

from safe_rl.models.heads import _Components, choices


class IndependentBeta(Independent):
    """Beta in every dimension of the action."""

    def __init__(self, alpha, beta):
        super().__init__(Beta(alpha, beta), 1)

    @property
    def deterministic_sample(self):
        return self.mean


class Anonymous(Distribution):
    """A normal distribution that tells neither its entropy nor what it is made of."""

    arg_constraints = {}  # noqa: RUF012
    has_rsample = True

    def __init__(self, loc, scale):
        self.hidden = IndependentNormal(loc, scale)
        super().__init__(self.hidden.batch_shape, self.hidden.event_shape, validate_args=False)

    def rsample(self, sample_shape=()):
        return self.hidden.rsample(sample_shape)

    def log_prob(self, value):
        return self.hidden.log_prob(value)


class Unreparametrised(Anonymous):
    has_rsample = False

    def sample(self, sample_shape=()):
        return self.hidden.sample(sample_shape)


class LearnedTransform(TransformedDistribution):
    """The same standard normal for every policy, shifted and stretched as each has learned."""

    def __init__(self, loc, scale):
        standard = IndependentNormal(torch.zeros_like(loc), torch.ones_like(scale))
        super().__init__(standard, AffineTransform(loc, scale, event_dim=1))


class Positive(nn.Module):
    """Two parameters above 1 per dimension."""

    def forward(self, x):
        return tuple((1 + nn.functional.softplus(x)).chunk(2, -1))


class Number(nn.Module):
    """Mean and standard deviation of an action that is no vector."""

    def forward(self, x):
        return tuple(part.squeeze(-1) for part in NormalParamExtractor()(x))


KINDS = {
    "normal": (4, NormalParamExtractor(), ["loc", "scale"], IndependentNormal),
    "number": (2, Number(), ["loc", "scale"], Normal),
    "bounded_tanh_normal": (
        4, NormalParamExtractor(), ["loc", "scale"],
        functools.partial(TanhNormal, low=-2.0, high=3.0),
    ),
    "learned_transform": (4, NormalParamExtractor(), ["loc", "scale"], LearnedTransform),
    "truncated_normal": (4, NormalParamExtractor(), ["loc", "scale"], TorchRLTruncatedNormal),
    "beta": (4, Positive(), ["alpha", "beta"], IndependentBeta),
    "categorical": (5, nn.Identity(), ["logits"], Categorical),
    "one_hot": (5, nn.Identity(), ["logits"], OneHotCategorical),
    "unequal_multi_discrete": (5, _Components([2, 3]), ["logits"], choices),
    "anonymous": (4, NormalParamExtractor(), ["loc", "scale"], Anonymous),
    "unreparametrised": (4, NormalParamExtractor(), ["loc", "scale"], Unreparametrised),
}  # fmt: skip
SAMPLED_KL = {"learned_transform", "truncated_normal", "anonymous", "unreparametrised"}


def make_actor(kind):
    outputs, head, keys, distribution = KINDS[kind]
    net = nn.Sequential(nn.Linear(NUM_OBS, 6), nn.Tanh(), nn.Linear(6, outputs), head)
    return ProbabilisticActor(
        TensorDictModule(net, in_keys=["observation"], out_keys=keys),
        in_keys=keys,
        distribution_class=distribution,
        default_interaction_type=ExplorationType.RANDOM,
        return_log_prob=True,
    )


def make_case(kind, samples=64, costs=1):
    actor = make_actor(kind)
    batch = TensorDict(observation=torch.randn(samples, NUM_OBS), batch_size=[samples])
    with torch.no_grad():
        actor(batch)
    batch["advantage"] = torch.randn(samples, 1)
    batch["cost_advantage"] = torch.randn(samples, costs)
    return actor, batch
