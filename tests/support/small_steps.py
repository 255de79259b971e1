"""A run, its method and a batch for single training steps; a batch in chunks; gradients, and tensors compared."""

from dataclasses import replace
from functools import partial

import torch
from torch import Tensor, nn

from mvitac.methods.base import Method, Views
from mvitac.methods.mvitac import MViTacConfig
from mvitac.recipes import recipe
from mvitac.run import Optim, Run
from support.toy import Toy

RUN = replace(recipe("smoke"), optim=Optim(lr=1e-3), method=MViTacConfig(hidden=24, out=12, dropout=0.3))


def build(run: Run = RUN, norm: bool = True, num_rows: int = 12) -> Method:
    torch.manual_seed(0)
    method = run.method.build(Toy().spec(), run.encoder)
    method.prepare(torch.arange(num_rows))
    for layer in method.modules():
        if isinstance(layer, nn.BatchNorm2d):
            nn.init.ones_(layer.weight)  # timm starts each block's last BatchNorm at zero, which would hide the block
        if isinstance(layer, (nn.BatchNorm1d, nn.BatchNorm2d)) and not norm:
            layer.eval()
    return method


def views(num: int = 12) -> Views:
    generator = torch.Generator().manual_seed(5)
    images = {m: [torch.randn(num, 3, 32, 32, generator=generator) for _ in range(2)] for m in ("vision", "touch")}
    return Views(images=images, labels={}, rows=torch.arange(num))


def split(batch: Views, size: int) -> list[partial[Views]]:
    pieces = {m: [v.split(size) for v in vs] for m, vs in batch.images.items()}
    parts = [{m: [v[i] for v in vs] for m, vs in pieces.items()} for i in range(len(batch.rows) // size)]
    rows = batch.rows.split(size)
    return [partial(Views, images=images, labels={}, rows=own) for images, own in zip(parts, rows, strict=True)]


def gradients(method: Method) -> dict[str, Tensor]:
    return {name: p.grad.clone() for name, p in method.named_parameters() if p.grad is not None}


def assert_close(a: dict[str, Tensor], b: dict[str, Tensor], rtol: float) -> None:
    """Relative to each tensor's largest entry: single entries may be sums that cancel."""
    assert a.keys() == b.keys() and a
    for name in a:
        error, scale = (a[name] - b[name]).abs().max(), a[name].abs().max()
        assert error <= rtol * scale + 1e-7, (name, float(error), float(scale))
