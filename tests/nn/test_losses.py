"""InfoNCE against closed forms and against a slow transcription of eq. 8."""

import math

import pytest
import torch

from mvitac.nn.losses import info_nce
from support.slow_losses import slow_info_nce


@pytest.mark.parametrize("tau", [0.07, 0.2, 0.5, 1.0])
def test_equals_transcription(tau: float) -> None:
    generator = torch.Generator().manual_seed(1)
    q, k = torch.randn(9, 5, generator=generator), torch.randn(9, 5, generator=generator)
    assert float(info_nce(q, k, tau)) == pytest.approx(slow_info_nce(q, k, tau), rel=1e-5)


@pytest.mark.parametrize("num", [2, 7, 64])
def test_constant_embeddings_cost_log_b(num: int) -> None:
    same = torch.ones(num, 4)
    assert float(info_nce(same, same, 0.07)) == pytest.approx(math.log(num), rel=1e-5)


@pytest.mark.parametrize("tau", [0.07, 1.0])
def test_orthogonal_pairs(tau: float) -> None:
    """Matched orthonormal rows: L = log(1 + (B - 1) exp(-1 / tau))."""
    eye = torch.eye(6)
    assert float(info_nce(eye, eye, tau)) == pytest.approx(math.log1p(5 * math.exp(-1 / tau)), rel=1e-4, abs=1e-6)


def test_scale_of_embeddings_does_not_count() -> None:
    q, k = torch.randn(8, 4), torch.randn(8, 4)
    torch.testing.assert_close(info_nce(q, k, 0.1), info_nce(3 * q, 0.2 * k, 0.1))


def test_is_fp32_under_autocast() -> None:
    """bf16 embeddings under bf16 autocast give the loss of their fp32 copies exactly."""
    q, k = torch.randn(32, 16).bfloat16(), torch.randn(32, 16).bfloat16()
    with torch.autocast("cpu", torch.bfloat16):
        inside = info_nce(q, k, 0.07)
    assert inside.dtype == torch.float32
    assert float(inside) == float(info_nce(q.float(), k.float(), 0.07))


def test_gradient_pulls_pairs_together() -> None:
    q = torch.randn(8, 4, requires_grad=True)
    k = torch.randn(8, 4)
    before = torch.cosine_similarity(q.detach(), k).mean()
    info_nce(q, k, 0.5).backward()
    after = torch.cosine_similarity((q - 0.5 * q.grad).detach(), k).mean()  # type: ignore[operator]
    assert after > before
