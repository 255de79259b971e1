"""The random views of each step, which are a function of (seed, step)."""

from collections.abc import Iterator
from functools import partial

import numpy as np
import torch
from torch import Tensor

from mvitac.data.lazy import Lazy
from mvitac.data.pack import Pack
from mvitac.methods.base import Views
from mvitac.run import Run
from mvitac.system.distributed import World
from mvitac.training.loader import Feed, ahead, prefetch
from mvitac.training.sampler import batches, mix, partners
from mvitac.training.step import Chunk
from mvitac.transforms.random_views import random_view


def load_chunks(
    run: Run,
    pack: Pack,
    rows: np.ndarray,
    num_views: int,
    device: torch.device,
    world: World,
    start: int,
    num_steps: int,
) -> Iterator[list[Chunk]]:
    """The chunks of each step's batch that this process embeds.

    Views depend on (seed, step, number of the chunk) only. Two processes thus see the same views as one process with chunks
    of half the batch.
    """
    feed = Feed(pack, device)
    share = run.batch_size // world.size
    per_process = share // (run.chunk or share)
    num_chunks = per_process * world.size

    def make(step: int, batch: np.ndarray, number: int) -> Views:
        seed = mix(run.seed, step) if num_chunks == 1 else mix(run.seed, step, number)
        own = np.split(batch, num_chunks)[number]
        return make_views(run, pack, own, num_views, torch.Generator().manual_seed(seed), device, feed)

    numbers = range(per_process * world.rank, per_process * (world.rank + 1))
    steps = enumerate(batches(run, pack, rows, start, num_steps), start=start)
    if per_process == 1 and (device.type == "cuda" or any(isinstance(i, Lazy) for i in pack.images.values())):
        # One chunk per step, and slow to make or needed on a GPU: make the next ones while this one is used.
        views = (make(step, batch, numbers[0]) for step, batch in steps)
        for made in ahead(views, device) if device.type == "cuda" else prefetch(views):
            yield [lambda made=made: made]
        return
    for step, batch in steps:
        yield [partial(make, step, batch, number) for number in numbers]


def make_views(
    run: Run,
    pack: Pack,
    rows: np.ndarray,
    num_views: int,
    generator: torch.Generator,
    device: torch.device,
    feed: Feed,
) -> Views:
    """Make random views of pack rows [B] on ``device``, in the precision that the networks read them in.

    All randomness comes from ``generator``.
    """
    views = [rows] * num_views
    if run.positives != "same-image":
        of = "presses" if run.positives == "same-press" else "touch_groups"
        views[1:] = [partners(pack, rows, generator, of, run.positives_within) for _ in range(num_views - 1)]
    sources = dict.fromkeys(pack.spec.modalities, views)
    if run.positives == "same-touch-pairs" and num_views == 1:
        sources["touch"] = [partners(pack, rows, generator, within=run.positives_within)]
    if run.method.sensor_view:
        sources["touch"] = [*sources["touch"], partners(pack, rows, generator, "presses", other_sensor=True)]
    dtype = torch.bfloat16 if run.bf16 else torch.float32
    images: dict[str, list[Tensor]] = {}
    has = senses(pack, rows)
    both: dict[str, Tensor] = {}
    if not all(there.all() for there in has.values()):
        pairs = np.logical_and.reduce(list(has.values()))
        both = {m: torch.from_numpy(np.flatnonzero(pairs[there])).to(device) for m, there in has.items()}
        sources = {m: _some(sources[m], there) for m, there in has.items()}
    for modality in has:
        config, images[modality] = run.augment.of(modality), []
        size, levels = run.augment.size_of(modality), run.encoder[modality].levels
        fed: dict[int, Tensor] = {}  # load an image once for two views
        for source in sources[modality]:
            seen = fed[id(source)] if id(source) in fed else fed.setdefault(id(source), feed(modality, source))
            view = random_view(seen, config, size, generator, dtype, levels)
            images[modality].append(view)
    splits = run.method.label_splits
    labels = {t.name: torch.from_numpy(pack.labels(t.name, *splits)[rows]).to(device) for t in pack.spec.tasks}
    values = {task: value.to(device) for task, value in values_of(run, pack, rows).items()}
    at, seed = torch.from_numpy(rows).to(device), torch.tensor(generator.initial_seed()).to(device)
    return Views(images=images, labels=labels, rows=at, values=values, both=both, seed=seed)


def _some(sources: list[np.ndarray], kept: np.ndarray) -> list[np.ndarray]:
    """The rows ``kept`` of each of ``sources``. What was one array twice still is."""
    fewer = {id(source): source[kept] for source in sources}
    return [fewer[id(source)] for source in sources]


def senses(pack: Pack, rows: np.ndarray) -> dict[str, np.ndarray]:
    """Modality -> bool [B], which of ``rows`` have an image. Of a mix, modalities of fewer than two rows are left out."""
    if not pack.parts:
        return dict.fromkeys(pack.spec.modalities, np.ones(len(rows), bool))
    has = {modality: pack.has(modality)[rows] for modality in pack.spec.modalities}
    return {modality: there for modality, there in has.items() if there.sum() > 1}


def values_of(run: Run, pack: Pack, rows: np.ndarray) -> dict[str, Tensor]:
    """``Views.values`` of pack rows [B]: NaN also where the method may not read them."""
    splits = run.method.label_splits
    return {task.name: torch.from_numpy(pack.values(task, *splits)[rows]).float() for task in pack.spec.values}
