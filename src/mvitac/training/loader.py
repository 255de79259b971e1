"""Loading the images of a step: from the pack, or from a copy of it in GPU memory; and preparing batches in a thread.

Shapes: images are uint8 [N, H, W, C] in the pack and are returned as [B, C, H, W] (channels-last).
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mvitac.data.pack import Images, Pack
from mvitac.methods.base import Views
from mvitac.system.prefetch import prefetch

SHARE = 0.4  # share of the free GPU memory that a copy of the pack may take


class ImageLoader:
    """Images of a pack on a device. A GPU keeps the whole pack, decoded, if it fits, or gets parts by pinned memory."""

    def __init__(self, pack: Pack, device: torch.device) -> None:
        self.pack, self.device, self.resident = pack, device, {}
        if device.type == "cuda":
            size = sum(pack.images[m].nbytes for m in pack.spec.modalities)
            if size < SHARE * torch.cuda.mem_get_info(device)[0]:
                self.resident = {m: self._upload(pack.images[m]) for m in pack.spec.modalities}

    def _upload(self, images: Images) -> Tensor:
        whole = torch.empty(images.shape, dtype=torch.uint8, device=self.device)
        for start in range(0, len(images), 4096):  # read the file once, in order
            piece = np.array(images[start : start + 4096])  # a copy: torch warns of an array that cannot be written
            whole[start : start + 4096] = torch.from_numpy(piece)
        return whole

    def __call__(self, modality: str, rows: np.ndarray) -> Tensor:
        """Images of ``rows``: uint8 [len(rows), C, H, W] on the device."""
        if modality in self.resident:
            index = torch.from_numpy(rows).pin_memory().to(self.device, non_blocking=True)
            return self.resident[modality].index_select(0, index).permute(0, 3, 1, 2)
        images = torch.from_numpy(self.pack.images[modality][rows])
        if self.device.type == "cuda":
            images = images.pin_memory().to(self.device, non_blocking=True)
        return images.to(self.device).permute(0, 3, 1, 2)


def prefetch_cuda(batches: Iterator[Views], device: torch.device) -> Iterator[Views]:
    """Prepare ``batches`` in a thread on a CUDA stream of their own, so that the network does not wait for its input."""
    side = torch.cuda.Stream(device)

    def on_side() -> Iterator[tuple[Views, Any]]:
        while True:
            with torch.cuda.device(device), torch.cuda.stream(side):
                if (batch := next(batches, None)) is None:
                    return
                yield batch, side.record_event()

    for batch, made in prefetch(on_side()):
        stream = torch.cuda.current_stream(device)
        stream.wait_event(made)
        answers = (*batch.labels.values(), *batch.values.values(), *batch.both.values())
        for tensor in [batch.rows, batch.seed, *answers, *(v for views in batch.images.values() for v in views)]:
            tensor.record_stream(stream)  # else its memory could be reused while the network reads it
        yield batch
