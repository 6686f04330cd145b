"""Updates multiply matrices by the kernels that suit the processor, to the same precision."""

import pytest
import torch
from point_mass_runs import point_mass_trainer

from safe_rl.algorithms import processor_use
from safe_rl.algorithms.processor_use import fast_products, prefers_onednn
from safe_rl.models.networks import cpuinfo

ZEN = "vendor_id : AuthenticAMD\nmodel name : AMD EPYC\nflags : fpu avx2 avx512f avx512_bf16\n"


@pytest.fixture
def of_use(monkeypatch):
    monkeypatch.setattr(processor_use, "prefers_onednn", lambda cpuinfo: True)
    products = torch.backends.mkldnn.matmul
    before = products.fp32_precision
    yield products
    products.fp32_precision = before


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (ZEN, True),
        (ZEN.replace("AuthenticAMD", "GenuineIntel"), False),
        (ZEN.replace(" avx512f", ""), False),
        (ZEN.replace("avx512_bf16", "amx_tile"), False),
        ("CPU implementer : 0x41\nFeatures : fp asimd bf16", False),
        ("", False),
    ],
)
def test_only_where_it_is_faster_and_rounds_nothing(text, expected):
    assert prefers_onednn(text) is expected


@pytest.mark.skipif(not prefers_onednn(cpuinfo()), reason="a processor that MKL serves well")
def test_products_are_those_of_single_precision():
    rows, inner, columns = 4000, 60, 64
    generator = torch.Generator().manual_seed(0)
    left = torch.randn(rows, inner, generator=generator)
    right = torch.randn(inner, columns, generator=generator)
    exact = left.double() @ right.double()
    with fast_products():
        product = left @ right
    rounded = left.bfloat16().double() @ right.bfloat16().double()
    error = (product - exact).abs().mean()
    assert error < 1e-5
    assert (rounded - exact).abs().mean() > 1000 * error  # what would be lost by bfloat16


def test_it_is_for_the_block_alone(of_use):
    seen = []

    def diverge():
        with fast_products():
            seen.append(of_use.fp32_precision)
            raise FloatingPointError

    before = of_use.fp32_precision
    with pytest.raises(FloatingPointError):
        diverge()
    assert (seen, of_use.fp32_precision) == (["bf16"], before)


def test_a_precision_of_the_users_is_kept(of_use):
    of_use.fp32_precision = "ieee"
    with fast_products():
        assert of_use.fp32_precision == "ieee"


def test_a_torch_without_it_keeps_its_own(of_use, monkeypatch):
    monkeypatch.setattr(torch.backends.mkldnn, "is_available", lambda: False)
    with fast_products():
        assert of_use.fp32_precision == "none"


def test_training_has_it_for_updates_alone(of_use, tmp_path):
    trainer = point_mass_trainer(tmp_path, "algo=ppo", "frames=160")
    learn, seen = trainer.algorithm.learn, []

    def watched(*args):
        seen.append(of_use.fp32_precision)
        return learn(*args)

    trainer.algorithm.learn = watched
    trainer.run()
    assert set(seen) == {"bf16"}
    assert of_use.fp32_precision == "none"
