"""The quick hyperbolic tangent against torch's own."""

import pytest
import torch

from safe_rl.models import networks
from safe_rl.models.networks import Tanh

QUICK = Tanh()


@pytest.fixture(autouse=True)
def a_processor_that_mkl_does_not_suit(monkeypatch):
    monkeypatch.setattr(networks, "_MKL_IS_QUICK", False)


def inputs(**options):
    around_zero = torch.linspace(-3, 3, 501)
    far = torch.tensor([-torch.inf, -90.0, -1e-8, 1e-8, 90.0, torch.inf])
    return torch.cat([around_zero, far]).requires_grad_(**options)


@pytest.mark.parametrize("requires_grad", [False, True])
def test_it_is_the_tangent(requires_grad):
    x = inputs(requires_grad=requires_grad)
    before = x.detach().clone()
    torch.testing.assert_close(QUICK(x).double(), before.double().tanh(), atol=2e-7, rtol=0)
    assert torch.equal(x, before)
    assert QUICK(torch.tensor(torch.nan)).isnan()


def test_gradients_of_first_and_second_order_are_the_tangents():
    found = []
    for function in (QUICK, torch.tanh):
        x = inputs()
        (first,) = torch.autograd.grad(function(x).square().sum(), x, create_graph=True)
        (second,) = torch.autograd.grad(first.sum(), x)
        found.append((first.detach(), second))
    torch.testing.assert_close(found[0], found[1], atol=2e-6, rtol=0)


def test_it_can_be_mapped_and_differentiated_forwards():
    x = torch.randn(5, 3)
    mapped = torch.func.vmap(torch.func.grad(lambda row: QUICK(row).sum()))(x)
    torch.testing.assert_close(mapped, 1 - x.tanh().square(), atol=2e-6, rtol=0)
    _, pushed = torch.func.jvp(QUICK, (x,), (x,))
    torch.testing.assert_close(pushed, x * (1 - x.tanh().square()), atol=2e-6, rtol=0)


def test_gradients_of_what_is_mapped_are_the_tangents():
    """So TorchRL's losses evaluate several networks of a kind: gradients are taken outside."""
    weights, x = torch.randn(2, 4, 3, requires_grad=True), torch.randn(5, 3)
    found = [
        torch.autograd.grad(torch.vmap(lambda w, f=f: f(x @ w.T))(weights).square().sum(), weights)
        for f in (QUICK, torch.tanh)
    ]
    torch.testing.assert_close(*found, atol=2e-6, rtol=1e-5)


@pytest.mark.parametrize("dtype", [torch.float64, torch.bfloat16])
def test_other_precisions_are_torchs_own(dtype):
    x = torch.randn(100, dtype=dtype)
    assert torch.equal(QUICK(x), x.tanh())


@pytest.mark.long
def test_it_compiles():
    x = torch.randn(7, 3, requires_grad=True)
    compiled = torch.compile(QUICK, backend="aot_eager", fullgraph=True)
    torch.testing.assert_close(compiled(x), x.tanh())
