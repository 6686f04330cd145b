"""KL divergence, entropy and log-probabilities of policies with any distribution.

There are closed forms for Normals and for everything registered with
`torch.distributions.kl_divergence`; other distributions are evaluated from samples. A tanh-Normal
counts as a Normal: its transform is the same for every policy, so it changes neither KL divergence
nor Fisher information.
"""

from __future__ import annotations

import torch
from tensordict.nn import ProbabilisticTensorDictModule, ProbabilisticTensorDictSequential
from torch import Tensor
from torch.distributions import (
    Categorical,
    Distribution,
    Independent,
    Normal,
    TransformedDistribution,
    kl_divergence,
)
from torchrl.modules import TanhNormal
from torchrl.modules.distributions import has_analytic_entropy, has_analytic_kl
from torchrl.modules.distributions.utils import sample_and_log_prob


def categorical_kl(p: Categorical, q: Categorical) -> Tensor:
    """KL(p ‖ q) of categorical distributions, [...], whose gradient is finite with masked choices.

    A choice that is masked in both distributions adds 0 to the divergence. There torch's own
    function multiplies 0 by −∞ + ∞, whose gradient is NaN.
    """
    change = (p.logits - q.logits).masked_fill(p.probs == 0, 0.0)
    return (p.probs * change).masked_fill((q.probs == 0) & (p.probs > 0), torch.inf).sum(-1)


def root(distribution: Distribution) -> Distribution:
    """The base distribution, without Independent and without transforms that are not learned."""
    while isinstance(distribution, Independent | TanhNormal):
        distribution = distribution.base_dist
    return distribution


def has_closed_kl(distribution: Distribution) -> bool:
    """Whether the divergence between two distributions of this kind needs no samples."""
    under = root(distribution)
    if isinstance(under, TransformedDistribution):
        # torch has a closed form for equal transforms only, which ignores what they have learned
        return False
    return isinstance(under, Normal) or has_analytic_kl(distribution, distribution)


def kl(p: Distribution, q: Distribution, log_weight: Tensor) -> Tensor:
    """KL(p ‖ q) of two distributions of the same kind, one number per state.

    Without a closed form it is estimated from an action a that q sampled in each state, as ρ log ρ
    − ρ + 1 with ρ = p(a)/q(a). The estimate is unbiased and never negative. For p = q it is 0 with
    a zero gradient (Schulman, *Approximating KL divergence*, 2020). `log_weight` is log ρ of these
    actions, [...].
    """
    roots = root(p), root(q)
    if isinstance(roots[0], Normal) and isinstance(roots[1], Normal):
        divergence = kl_divergence(*roots)
        # an action may have any number of dimensions
        return divergence.flatten(len(p.batch_shape)).sum(-1) if p.event_shape else divergence
    if isinstance(p, Categorical) and isinstance(q, Categorical):
        return categorical_kl(p, q)
    if has_closed_kl(p) and has_analytic_kl(p, q):
        return kl_divergence(p, q)
    ratio = log_weight.exp()
    return ratio * log_weight - ratio + 1


def entropy(distribution: Distribution) -> Tensor:
    """Differentiable entropy per state, [...]: in closed form, or −log π(a) of one sampled action.

    The gradient of a sampled entropy goes through the sample if the distribution allows it.
    Otherwise it is the score-function gradient. Both are unbiased.
    """
    if has_analytic_entropy(distribution):
        return distribution.entropy()
    _, log_prob = sample_and_log_prob(distribution, reparameterize=distribution.has_rsample)
    if distribution.has_rsample:
        return -log_prob
    fixed = log_prob.detach()
    return -fixed * (1 + log_prob - fixed)


def sampler_of(actor: ProbabilisticTensorDictSequential) -> ProbabilisticTensorDictModule:
    """The module of an actor that builds its distribution from parameters."""
    return [m for m in actor.modules() if isinstance(m, ProbabilisticTensorDictModule)][-1]


class ReferencePolicy:
    """The current policy's distribution in the states of a batch, without gradients."""

    def __init__(self, distribution: Distribution) -> None:
        self.distribution = distribution
        self._sample: tuple[Tensor, Tensor] | None = None
        if not has_closed_kl(distribution):
            with torch.no_grad():
                self._sample = sample_and_log_prob(distribution)

    def kl(self, policy: Distribution) -> Tensor:
        """KL(policy ‖ reference) per state, [...]; an estimate uses the same samples every time."""
        log_weight = torch.empty(0)
        if self._sample is not None:
            action, log_prob = self._sample
            log_weight = policy.log_prob(action) - log_prob
        return kl(policy, self.distribution, log_weight)
