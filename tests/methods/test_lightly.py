"""Our losses beside lightly's, where it is installed (`pip install --no-deps lightly lightly-utils`)."""

from __future__ import annotations

import pytest
import torch

from mvitac.methods.byol import regression
from mvitac.methods.dino import DINO, DINOConfig
from mvitac.methods.simclr import nt_xent
from mvitac.methods.vicreg import VICReg, VICRegConfig
from mvitac.nn.encoders import SCRATCH, Encoders
from mvitac.nn.losses import queue_nce
from support.toy import Toy

loss = pytest.importorskip("lightly.loss")
TINY = Encoders.both(trunk="mvitac_tiny", weights=SCRATCH)


@pytest.fixture
def z() -> tuple[torch.Tensor, torch.Tensor]:
    torch.manual_seed(4)
    return torch.randn(12, 16), torch.randn(12, 16)


def test_nt_xent(z: tuple[torch.Tensor, torch.Tensor]) -> None:
    torch.testing.assert_close(nt_xent(*z, 0.3), loss.NTXentLoss(temperature=0.3)(*z))


def test_queue(z: tuple[torch.Tensor, torch.Tensor]) -> None:
    """MoCo's form: the keys of a memory bank are the only negatives."""
    theirs = loss.NTXentLoss(temperature=0.2, memory_bank_size=(32, 16))
    theirs(*z)  # its bank begins as noise and takes these keys in
    bank = theirs.memory_bank.bank
    keys = torch.nn.functional.normalize(bank if bank.shape == (32, 16) else bank.T, dim=1)
    torch.testing.assert_close(queue_nce(*z, keys.clone(), 0.2), theirs(*z))


def test_byol(z: tuple[torch.Tensor, torch.Tensor]) -> None:
    torch.testing.assert_close(regression(*z), 2 + 2 * loss.NegativeCosineSimilarity()(*z))


def test_vicreg(z: tuple[torch.Tensor, torch.Tensor]) -> None:
    method = VICReg(VICRegConfig(hidden=16), Toy().spec(), TINY)
    ours = method.contrast({(m, i): z[i] for m in ("vision", "touch") for i in (0, 1)})
    torch.testing.assert_close(ours["vision"], loss.VICRegLoss()(*z))


def test_dino(z: tuple[torch.Tensor, torch.Tensor]) -> None:
    method = DINO(DINOConfig(out=16, hidden=8), Toy().spec(), TINY)
    torch.nn.init.normal_(method.centre)
    theirs = loss.DINOLoss(output_dim=16, teacher_temp=0.04, student_temp=0.1, warmup_teacher_temp_epochs=0)
    theirs.center.copy_(method.centre[0][None, None])
    views = [torch.randn(12, 16) for _ in range(4)]
    names = [(tower, m, i) for m in ("vision", "touch") for tower in ("student", "teacher") for i in (0, 1)]
    ours = method.contrast(dict(zip(names, [*views, *views], strict=True)))
    torch.testing.assert_close(ours["vision"], theirs(views[2:], views[:2]))
