"""InfoNCE against closed forms and against a slow transcription of eq. 8."""

import pytest
import torch

from mvitac.nn.losses import info_nce
from support.slow_losses import slow_info_nce


@pytest.mark.parametrize("tau", [0.07, 0.2, 0.5, 1.0])
def test_equals_transcription(tau: float) -> None:
    generator = torch.Generator().manual_seed(1)
    q, k = torch.randn(9, 5, generator=generator), torch.randn(9, 5, generator=generator)
    assert float(info_nce(q, k, tau)) == pytest.approx(slow_info_nce(q, k, tau), rel=1e-5)


def test_is_fp32_under_autocast() -> None:
    """bf16 embeddings under bf16 autocast give the loss of their fp32 copies exactly."""
    q, k = torch.randn(32, 16).bfloat16(), torch.randn(32, 16).bfloat16()
    with torch.autocast("cpu", torch.bfloat16):
        inside = info_nce(q, k, 0.07)
    assert inside.dtype == torch.float32
    assert float(inside) == float(info_nce(q.float(), k.float(), 0.07))
