"""Pieces of trust-region steps against dense linear algebra and finite differences."""

from functools import partial

import pytest
import torch
from cmdp import make_actor as make_fixed_width_actor
from policy_kinds import KINDS
from policy_kinds import make_actor as make_actor_of_kind
from samples import NUM_ACTIONS, NUM_OBS, perturb
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.modules import IndependentNormal, ProbabilisticActor

from safe_rl.models import make_actor
from safe_rl.objectives.distributions import ReferencePolicy
from safe_rl.objectives.trust_region import (
    FisherProduct,
    best_in_span,
    conjugate_gradient,
    flat_gradient,
    flatten,
    policy_in,
    set_parameters,
)

SIZES = {"hidden_sizes": [5], "initial_log_std": -0.5}
ACTORS = {kind: partial(make_actor_of_kind, kind) for kind in KINDS} | {
    "state-independent scale": partial(make_actor, NUM_OBS, NUM_ACTIONS, **SIZES),
    "constant scale": make_fixed_width_actor,
}


def setup_actor(name, batch_size=(7,)):
    actor = ACTORS[name]().double()
    perturb(actor, 0.3)
    parameters = list(actor.parameters())
    observation = torch.randn(*batch_size, parameters[0].shape[-1], dtype=torch.float64)
    return actor, TensorDict(observation=observation, batch_size=batch_size), parameters


@pytest.mark.parametrize("batch_size", [(7,), (3, 4)])
@pytest.mark.parametrize("name", ACTORS)
def test_fisher_product_is_the_second_difference_of_the_kl(name, batch_size):
    actor, batch, parameters = setup_actor(name, batch_size)
    torch.manual_seed(3)
    product = FisherProduct(actor, batch, parameters, damping=0.1)
    torch.manual_seed(3)  # where samples decide, the same ones
    with torch.no_grad():
        reference = ReferencePolicy(policy_in(actor, batch))
    start = flatten(parameters).detach()
    direction = torch.randn_like(start)
    curvature = direction @ (product(direction) - 0.1 * direction)
    size, values = 1e-4, []
    for sign in (1, -1):
        set_parameters(parameters, start + sign * size * direction)
        values.append(reference.kl(policy_in(actor, batch)).mean().detach())
    torch.testing.assert_close(sum(values) / size**2, curvature, rtol=1e-3, atol=1e-9)
    assert curvature > 0


def fisher_of_a_sequence(**options):
    """Whether cuDNN was in use in a recurrent layer, and the product with its policy's matrix."""
    gru, met = nn.GRU(NUM_OBS, NUM_ACTIONS, batch_first=True, **options), []
    gru.register_forward_hook(lambda *_: met.append(torch.backends.cudnn.enabled))
    location = TensorDictModule(gru, ["observation"], ["loc", "_"])
    net = TensorDictSequential(location, TensorDictModule(torch.exp, ["loc"], ["scale"]))
    actor = ProbabilisticActor(net, ["loc", "scale"], distribution_class=IndependentNormal)
    observation = torch.randn(2, 5, NUM_OBS, **options)
    batch = TensorDict(observation=observation, batch_size=[2, 5])
    product = FisherProduct(actor, batch, list(actor.parameters()), damping=0.1)
    return met, product(torch.ones(sum(p.numel() for p in actor.parameters()), **options))


def test_the_graph_that_is_differentiated_twice_is_none_of_cudnns():
    before = torch.backends.cudnn.enabled
    met, _ = fisher_of_a_sequence()
    assert met == [False]
    assert torch.backends.cudnn.enabled == before


@pytest.mark.gpu
def test_recurrent_policies_have_a_fisher_matrix_on_an_accelerator():
    assert fisher_of_a_sequence(device="cuda")[1].isfinite().all()


def test_frozen_parameters_are_left_out():
    actor, batch, parameters = setup_actor("normal")
    whole = FisherProduct(actor, batch, parameters, damping=0.0)
    part = FisherProduct(actor, batch, parameters[2:], damping=0.0)
    first = sum(parameter.numel() for parameter in parameters[:2])
    vector = torch.randn(sum(p.numel() for p in parameters), dtype=torch.float64)
    vector[:first] = 0
    torch.testing.assert_close(part(vector[first:]), whole(vector)[first:])


def test_conjugate_gradient_against_a_direct_solve():
    size = 20
    root = torch.randn(size, size, dtype=torch.float64)
    matrix = root @ root.T + torch.eye(size, dtype=torch.float64)
    right = torch.randn(size, dtype=torch.float64)
    solution, _ = conjugate_gradient(matrix.__matmul__, right, iterations=60, tolerance=1e-24)
    torch.testing.assert_close(solution, torch.linalg.solve(matrix, right))


def test_conjugate_gradient_stops_and_never_divides_by_zero():
    products = []

    def product(vector):
        products.append(vector)
        return 2 * vector

    assert not conjugate_gradient(product, torch.zeros(4), 10)[0].any()
    assert not products
    solution, _ = conjugate_gradient(product, torch.ones(4), 10)
    torch.testing.assert_close(solution, torch.full((4,), 0.5))
    assert len(products) == 1


def ill_conditioned_system(size=60, rows=3):
    """A system that five conjugate gradients leave far from solved."""
    root = torch.randn(size, size, dtype=torch.float64)
    basis = torch.linalg.qr(root).Q
    matrix = basis @ torch.diag(torch.logspace(-1, 2, size, dtype=torch.float64)) @ basis.T
    return matrix, torch.randn(rows, size, dtype=torch.float64)


def test_solutions_in_the_span_agree_with_each_other_and_are_better():
    matrix, right = ill_conditioned_system()
    pairs = [conjugate_gradient(matrix.__matmul__, row, 5) for row in right]
    rough, images = (torch.stack(rows) for rows in zip(*pairs, strict=True))
    torch.testing.assert_close(images, rough @ matrix)
    assert (images - right).norm() > 0.2 * right.norm()
    products = rough @ right.T
    assert (products - products.T).abs().max() > 0.01 * products.diagonal().max()
    found = best_in_span(rough, images, right)
    products = found @ right.T
    torch.testing.assert_close(products, products.T)
    torch.testing.assert_close(products, found @ matrix @ found.T)
    error, rough_error = (x - torch.linalg.solve(matrix, right.T).T for x in (found, rough))
    assert ((error @ matrix * error).sum(-1) <= (rough_error @ matrix * rough_error).sum(-1)).all()


def test_parallel_and_vanishing_right_hand_sides_are_no_trouble():
    matrix, right = ill_conditioned_system()
    right = torch.stack([right[0], -3 * right[0], 0 * right[0]]).float()
    pairs = [conjugate_gradient(matrix.float().__matmul__, row, 5) for row in right]
    rough, images = (torch.stack(rows) for rows in zip(*pairs, strict=True))
    torch.testing.assert_close(best_in_span(rough, images, right), rough, rtol=1e-4, atol=1e-5)


def test_flat_gradient_counts_unused_parameters_as_zero():
    used, unused = nn.Parameter(torch.ones(2)), nn.Parameter(torch.ones(3))
    gradient = flat_gradient((3 * used).sum(), [used, unused])
    assert gradient.tolist() == [3, 3, 0, 0, 0]
