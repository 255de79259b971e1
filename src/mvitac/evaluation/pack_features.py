"""Features of a pack's rows from a model, computed in chunks."""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from mvitac.data.pack import Pack
from mvitac.model import Model
from mvitac.system.malloc import keep_freed_memory


def pack_features(
    model: Model,
    pack: Pack,
    modality: str,
    rows: np.ndarray,
    *,
    for_heads: bool = False,
    bf16: bool = False,
    advance: Callable[[int], object] = lambda num: None,
) -> Tensor:
    """``Model.features`` [len(rows), D] of pack rows, computed in chunks on the model's device, on the CPU.

    ``advance`` is called with each chunk's number of rows.
    """
    device = next(model.parameters()).device
    if device.type == "cpu":
        keep_freed_memory()  # else every activation is mapped again: over twice the time on a virtual machine
    chunks = []
    for chunk in np.array_split(rows, max(1, len(rows) // 256)):
        images = torch.from_numpy(pack.images[modality][chunk]).permute(0, 3, 1, 2).to(device)
        chunks.append(model.features(modality, images, for_heads=for_heads, bf16=bf16).cpu())
        advance(len(chunk))
    return torch.cat(chunks)
