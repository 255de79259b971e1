"""The random views of each step's rows: a function of (seed, step)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from mvitac.data.jpeg import Lazy
from mvitac.data.pack import Pack
from mvitac.methods.base import Views
from mvitac.run import Run
from mvitac.system.distributed import World
from mvitac.training.loader import Feed, ahead, prefetch
from mvitac.training.sampler import batches, mix, partners
from mvitac.training.step import Chunk
from mvitac.transforms.gel_flip import GelMirror
from mvitac.transforms.random_views import random_view


def feed_parts(
    run: Run,
    pack: Pack,
    rows: np.ndarray,
    num_views: int,
    device: torch.device,
    world: World,
    start: int,
    num_steps: int,
    mirror: GelMirror | None = None,
) -> Iterator[list[Chunk]]:
    """The parts of each step's batch that this process embeds: chunk by chunk of its own share of the rows.

    Views depend on (seed, step, part) alone, so two processes see what one process sees with a chunk of half the batch.
    """
    feed = Feed(pack, device)
    share = run.batch_size // world.size
    per_process = share // (run.chunk or share)
    num_parts = per_process * world.size

    def part(step: int, batch: np.ndarray, number: int) -> Views:
        seed = mix(run.seed, step) if num_parts == 1 else mix(run.seed, step, number)
        chunk = np.split(batch, num_parts)[number]
        return make_views(run, pack, chunk, num_views, torch.Generator().manual_seed(seed), device, feed, mirror)

    numbers = range(per_process * world.rank, per_process * (world.rank + 1))
    expect = None if feed.resident else pack.expect
    steps = enumerate(batches(run, pack, rows, start, num_steps, world, expect), start=start)
    if per_process == 1 and (device.type == "cuda" or any(isinstance(i, Lazy) for i in pack.images.values())):
        views = (part(step, batch, numbers[0]) for step, batch in steps)
        for made in ahead(views, device) if device.type == "cuda" else prefetch(views):
            yield [partial(_same, made)]
        return
    for step, batch in steps:
        yield [partial(part, step, batch, number) for number in numbers]


def _same(views: Views) -> Views:
    return views


def gel_mirror(run: Run, pack: Pack, device: torch.device) -> GelMirror | None:
    """What flips the touches of ``run``'s views as touches, or None; ValueError if the pack's colours cannot be learned."""
    return GelMirror(pack, device) if run.augment.gel_flip == "colour" else None


def make_views(
    run: Run,
    pack: Pack,
    rows: np.ndarray,
    num_views: int,
    generator: torch.Generator,
    device: torch.device,
    feed: Feed,
    mirror: GelMirror | None = None,
) -> Views:
    """Random views of the pack's ``rows`` on ``device``, in the precision the networks read them in.

    ``mirror`` is what ``gel_mirror`` gave for the run.
    """
    assert (mirror is None) == (run.augment.gel_flip == "plain")
    views = [rows] * num_views
    if run.positives != "same-image":
        views[1:] = [partners(pack, rows, generator) for _ in range(num_views - 1)]
    sources = dict.fromkeys(pack.spec.modalities, views)
    if run.positives == "same-touch-pairs" and num_views == 1:
        sources["touch"] = [partners(pack, rows, generator)]
    dtype = torch.bfloat16 if run.bf16 else torch.float32
    images: dict[str, list[Tensor]] = {}
    for modality in pack.spec.modalities:
        config, images[modality] = getattr(run.augment, modality), []
        if mirror and modality == "touch":
            config = replace(config, flip=0.0)  # the mirror flips
        fed: dict[int, Tensor] = {}  # two views of one image need it once
        for source in sources[modality]:
            seen = fed[id(source)] if id(source) in fed else fed.setdefault(id(source), feed(modality, source))
            if mirror and modality == "touch":
                seen = mirror.random(seen, source, run.augment.touch, generator)
            view = random_view(seen, config, run.augment.size, generator, dtype)
            images[modality].append(view)
    labels = {t.name: torch.from_numpy(pack.labels(t.name, "train")[rows]).to(device) for t in pack.spec.tasks}
    return Views(images=images, labels=labels, rows=torch.from_numpy(rows).to(device))
