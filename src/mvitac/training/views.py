"""From the rows of a step to random views on the device: a function of (seed, step)."""

from collections.abc import Iterator, Mapping
from functools import partial

import numpy as np
import torch
from torch import Tensor

from mvitac.data.lazy import Lazy
from mvitac.data.pack import Pack
from mvitac.methods.base import Views
from mvitac.run import Run
from mvitac.system.distributed import World
from mvitac.training.loader import ImageLoader, prefetch, prefetch_cuda
from mvitac.training.sampler import Batches, combine_seeds, draw_positives
from mvitac.training.step import Chunk
from mvitac.transforms.random_views import apply, draw


class StepViews:
    """Random views of the rows of a step, as the chunks that this process embeds.

    They depend on (seed, step, number of the chunk) only. Two processes thus see the same views as one process with chunks
    of half the batch. ``num`` is the number of views of an image (``Method.views``). ``locked``: modality -> the
    features [pack.num, D] of a locked trunk, which it gives instead of images, because they do not vary.
    """

    def __init__(
        self,
        run: Run,
        pack: Pack,
        num: int,
        device: torch.device,
        world: World | None = None,
        locked: Mapping[str, Tensor] | None = None,
    ) -> None:
        self.run, self.pack, self.num, self.device, self.world = run, pack, num, device, world or World()
        self.images = ImageLoader(pack, device)
        self.locked = locked or {}
        share = run.batch_size // self.world.size
        self.chunks_per_process = share // (run.chunk or share)

    def iterate(self, batches: Batches, start: int, num_steps: int) -> Iterator[list[Chunk]]:
        """The chunks of each step; a single one that is slow to make, or for a GPU, is made while the last is used."""
        steps = (self(batches[step], step) for step in range(start, num_steps))
        slow = self.device.type == "cuda" or any(isinstance(images, Lazy) for images in self.pack.images.values())
        if self.chunks_per_process > 1 or not slow:
            yield from steps
            return
        views = (chunk() for (chunk,) in steps)
        for made in prefetch_cuda(views, self.device) if self.device.type == "cuda" else prefetch(views):
            yield [lambda made=made: made]

    def __call__(self, rows: np.ndarray, step: int) -> list[Chunk]:
        """The chunks of ``rows``, the whole batch of ``step``, that this process embeds."""
        chunks = np.split(rows, self.chunks_per_process * self.world.size)
        mine = range(self.chunks_per_process * self.world.rank, self.chunks_per_process * (self.world.rank + 1))
        return [partial(self.make, chunks[n], combine_seeds(self.run.seed, step, n)) for n in mine]

    def make(self, rows: np.ndarray, seed: int) -> Views:
        """Views of pack rows [B] on the device, in the precision that the networks read them in."""
        run, pack, generator, to = self.run, self.pack, torch.Generator().manual_seed(seed), self.device
        sources = self._view_rows(rows, generator)
        has, both = _present(pack, rows), {}
        if not all(there.all() for there in has.values()):
            pairs = np.logical_and.reduce(list(has.values()))
            both = {m: torch.from_numpy(np.flatnonzero(pairs[there])).to(to) for m, there in has.items()}
        dtype = torch.bfloat16 if run.bf16 else torch.float32
        images: dict[str, list[Tensor]] = {}
        for m, there in has.items():
            own = {id(source): source[there] for source in sources[m]}  # an image of two views is loaded once
            if m in self.locked:
                for source in sources[m]:  # the other modality's views stay the same
                    draw(run.augment.of(m), len(own[id(source)]), pack.size, generator)
            load = self.locked[m].__getitem__ if m in self.locked else partial(self.images, m)
            fed = {name: load(source) for name, source in own.items()}
            shown, how = [fed[id(source)] for source in sources[m]], (dtype, run.encoder[m].mean_std)
            if m not in self.locked:
                drawn = (draw(run.augment.of(m), len(one), pack.size, generator) for one in shown)
                shown = [apply(one, each, run.augment.size_of(m), *how) for one, each in zip(shown, drawn, strict=True)]
            images[m] = shown
        splits = run.method.label_splits
        labels = {t.name: torch.from_numpy(pack.labels(t.name, *splits)[rows]).to(to) for t in pack.spec.tasks}
        values = {task: value.to(to) for task, value in values_of(run, pack, rows).items()}
        return Views(images, labels, torch.from_numpy(rows).to(to), values, both, torch.tensor(seed).to(to))

    def _view_rows(self, rows: np.ndarray, generator: torch.Generator) -> dict[str, list[np.ndarray]]:
        """Modality -> the rows that each of its views shows (``Run.positives``)."""
        run, pack = self.run, self.pack
        views, others = [rows] * self.num, partial(draw_positives, pack, rows, generator, within=run.positives_within)
        if run.positives != "same-image":
            views[1:] = [others() for _ in views[1:]]
        sources = dict.fromkeys(pack.spec.modalities, views)
        if run.positives == "same-touch-pairs" and self.num == 1:
            sources["touch"] = [others()]
        if run.method.sensor_view:
            sources["touch"] = [*sources["touch"], draw_positives(pack, rows, generator, other_sensor=True)]
        return sources


def _present(pack: Pack, rows: np.ndarray) -> dict[str, np.ndarray]:
    """Modality -> bool [B], which of ``rows`` have an image. Of a mix, modalities of fewer than two rows are left out."""
    if not pack.parts:
        return dict.fromkeys(pack.spec.modalities, np.ones(len(rows), bool))
    has = {modality: pack.has(modality)[rows] for modality in pack.spec.modalities}
    return {modality: there for modality, there in has.items() if there.sum() > 1}


def values_of(run: Run, pack: Pack, rows: np.ndarray) -> dict[str, Tensor]:
    """``Views.values`` of pack rows [B]: NaN also where the method may not read them."""
    splits = run.method.label_splits
    return {task.name: torch.from_numpy(pack.values(task, *splits)[rows]).float() for task in pack.spec.values}
