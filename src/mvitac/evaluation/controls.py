"""Controls: what a probe reaches without learned features, on the same rows."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F

from mvitac.data.pack import Pack
from mvitac.data.spec import MODALITIES, AnyTask, DataSpec, Task
from mvitac.evaluation import probe
from mvitac.evaluation.few_labels import few, percent_of
from mvitac.evaluation.probe_config import Standardise
from mvitac.evaluation.retrieval import cross_modal
from mvitac.methods.simclr import SimCLRConfig
from mvitac.model import Model, fresh
from mvitac.nn import imagenet
from mvitac.nn.encoders import IMAGENET, SCRATCH, EncoderConfig, Encoders
from mvitac.run import Run
from mvitac.system.progress import work
from mvitac.system.threads import in_threads

CONTROLS = ("imagenet", "start", "untrained", "pixels", "border", "majority", "mean")
"""Names of the controls in the order of a table. The dataset's own controls come before the last two, of which a task has
one: the most common class, or the mean value."""
IMAGENET_SIDE = 128  # px: the control sees images of at least this side, enlarged if need be
Records = list[dict[str, Any]]


def thumbnails(pack: Pack, modality: str, rows: np.ndarray, side: int = 8) -> np.ndarray:
    """Control "pixels": the image averaged to side x side and flattened, [len(rows), side * side * C]."""
    means = []
    for chunk in np.array_split(rows, len(rows) // 64 + 1):  # as floats, all images may be larger than memory
        images = torch.from_numpy(pack.images[modality][chunk]).permute(0, 3, 1, 2).float() / 255
        means.append(F.adaptive_avg_pool2d(images, side).flatten(1))
    return torch.cat(means).numpy()


def borders(pack: Pack, modality: str, rows: np.ndarray, side: int = 16, width: int = 2) -> np.ndarray:
    """Control "border": the outer ring of a side x side thumbnail, where contact is rarely visible."""
    ring = np.ones((side, side), bool)
    ring[width:-width, width:-width] = False
    return thumbnails(pack, modality, rows, side).reshape(len(rows), -1, side, side)[:, :, ring].reshape(len(rows), -1)


def controls_of(
    runs: Sequence[Run],
    pack: Pack,
    tasks: Sequence[AnyTask],
    modalities: Sequence[str],
    probes: Sequence[str],
    specs: Sequence[DataSpec] = (),
    standardise: tuple[Standardise, ...] = (),
) -> tuple[Records, Records]:
    """Score every control for ``runs``: probe records and retrieval records, each with its "source" and "seed".

    Each gets the same ``probes``. ``specs``: what the runs were trained on, where that is not ``pack``. ``standardise``:
    as for the runs (``sensors.touch_features``), for the trunks.
    """
    records = label_controls(pack, tasks, modalities, probes)
    starts, weights = starts_of(runs, specs or [pack.spec] * len(runs)), frozen_trunks(runs)
    sources = len(modalities) * (1 + len(starts) + len(weights)) + ("touch" in modalities)
    num = sources * sum(len(probe.probes_of(task, probes)) for task in tasks)

    def probed(model: Model, which: Sequence[str] = modalities) -> Records:
        return probe.probe_model(model, pack, tasks, which, probes, standardise)

    with work("fitting probes of the controls", num, "probes"):
        records += pixel_controls(pack, tasks, modalities, probes)
        # Built one by one: threads would share the random generator.
        models = [fresh(_untrained(run, runs), spec, pack.size) for run, spec in starts]
        retrieval: Records = []
        scored = in_threads(lambda model: (probed(model), cross_modal(model, pack)), models)
        for (run, _), (found, ranked) in zip(starts, scored, strict=True):
            records += _named("untrained", run.seed, found)
            retrieval += _named("untrained", run.seed, ranked)
        for name, run in weights:
            # A modality that starts from random weights is no control, nor are both with it.
            which = [m for m in modalities if SCRATCH not in {run.encoder[o].weights for o in probe.names_in(m, pack)}]
            records += _named(name, None, probed(fresh(run, pack.spec, pack.size), which))
    return records, retrieval


def _untrained(run: Run, runs: Sequence[Run]) -> Run:
    """``run`` from random weights; a tower that all ``runs`` lock, so none trains, has its own if they are here."""
    locked = {m: run.encoder[m] for m in MODALITIES if all(each.encoder[m].locked for each in runs)}
    here = {
        m: imagenet.source(c.trunk) if c.weights == IMAGENET else Path(c.weights).is_file() for m, c in locked.items()
    }
    return replace(run, encoder=replace(run.encoder.fresh(), **{m: locked[m] for m in locked if here[m]}))


def _named(source: str, seed: int | None, found: Records) -> Records:
    return [{"source": source, "seed": seed, **record} for record in found]


def label_controls(
    pack: Pack, tasks: Sequence[AnyTask], modalities: Sequence[str] = (), probes: Sequence[str] = ("linear",)
) -> Records:
    """What needs no image: the most common class or the mean value, and the dataset's own controls (table columns).

    Where rows lack images, also on the rows of each of ``modalities``. Of values, a column gets a curve.
    """
    records = []
    for task, modality in [(t, m) for t in tasks for m in ("none", *probe.seen_by(pack, t, modalities))]:
        rows, whole = probe.split_rows(pack, task, modality), probe.split_rows(pack, task).all
        if modality != "none" and np.array_equal(rows.all, whole):
            continue
        guess, linear, kinds = "mean", "curve", ["curve", *filter(percent_of, probes)]
        if isinstance(task, Task):
            guess, linear, kinds = "majority", "linear", probe.probes_of(task, probes)
        found = []
        for kind in ("linear", *filter(percent_of, probes)):
            train, val = few(pack, task, rows.train, rows.val, percent_of(kind) or 100, seed=0)
            seen = np.concatenate([rows.train[train], rows.val[val]])
            if isinstance(task, Task):
                answer = np.eye(len(task.classes))[np.bincount(pack.labels(task.name)[seen]).argmax()]
            else:
                answer = np.nanmean(pack.values(task)[seen], axis=0)
            found.append((guess, kind, probe.score_rows(pack, task, rows.test, np.tile(answer, (len(rows.test), 1)))))
        for name, columns in pack.spec.controls.items():
            x = np.stack([pack.column(column).astype(float) for column in columns], axis=1)
            if np.isfinite(x[whole]).all():  # else rows of a part of a mix that has no such control
                fit = partial(probe.probe_features, x[rows.all], pack, task, rows, seed=0, few_kind=linear)
                found += [(name, kind, fit(kind)[0]) for kind in kinds]
        for name, kind, result in found:
            known = {"task": task.name, "modality": modality, "probe": "linear" if kind == "curve" else kind}
            records += _named(name, None, [{**known, **result}])
    return records


def pixel_controls(
    pack: Pack, tasks: Sequence[AnyTask], modalities: Sequence[str], probes: Sequence[str] = ("linear",)
) -> Records:
    records = _named("pixels", None, probe.probe_all(partial(thumbnails, pack), pack, tasks, modalities, probes, 0))
    if "touch" in modalities:
        records += _named("border", None, probe.probe_all(partial(borders, pack), pack, tasks, ["touch"], probes, 0))
    return records


def starts_of(runs: Sequence[Run], specs: Sequence[DataSpec]) -> list[tuple[Run, DataSpec]]:
    """The runs whose trunks before training are the controls, each with what it was trained on.

    One run for each seed, trunk and image size: the first with all modalities and heads into a shared space. Further
    runs are added only for modalities that it lacks.
    """
    built = []
    for run, spec in zip(runs, specs, strict=True):
        with torch.device("meta"):
            method = run.method.build(spec, run.encoder.fresh())
        built.append((run, spec, set(method.encoders()), len(method.projectors())))
    built.sort(key=lambda each: (len(each[2]), each[3]), reverse=True)
    found: list[tuple[Run, DataSpec]] = []
    covered: set[tuple[int, str, str, str, int]] = set()
    for run, spec, modalities, _ in built:
        parts = {(run.seed, m, run.encoder[m].trunk, run.encoder[m].pool, run.augment.whole_of(m)) for m in modalities}
        if not parts <= covered:
            covered |= parts
            found.append((run, spec))
    return found


def frozen_trunks(runs: Sequence[Run]) -> list[tuple[str, Run]]:
    """The pre-trained trunks to probe as they are, by name: ImageNet's, and files that ``runs`` started from.

    ImageNet is left out where no weights are installed or cached (``imagenet.source``). It sees images as large as the
    runs do, and at least ``IMAGENET_SIDE``, and gives all stages for both senses if the first run has those of one. Other
    people's encoders alone have no such row.
    """
    # The heads of SimCLR are not read; it takes any trunk and modality.
    runs = [replace(run, method=SimCLRConfig()) for run in runs]
    from_file = [run for run in runs if not {run.encoder[m].weights for m in MODALITIES} <= {IMAGENET, SCRATCH}]
    found = [("start", run) for run in {run.encoder: run for run in reversed(from_file)}.values()]
    trunks = {m: imagenet_trunk(run.encoder[m]) for run in runs[:1] for m in MODALITIES}
    if runs and (vision := trunks["vision"]) and (touch := trunks["touch"]):
        views = runs[0].augment
        sides = {m: max(views.whole_of(m), IMAGENET_SIDE) for m in MODALITIES}
        views = replace(views, **{m: replace(views.of(m), whole=side) for m, side in sides.items()})
        pool = "stages" if "stages" in (vision.pool, touch.pool) else "last"
        encoder = Encoders(vision=vision, touch=touch).changed(pool=pool)
        found.append(("imagenet", replace(runs[0], encoder=encoder, augment=views)))
    return found[::-1]


def imagenet_trunk(encoder: EncoderConfig) -> EncoderConfig | None:
    """The trunk of ``encoder`` with ImageNet weights, or one whose weights come as a package; None if none are here."""
    for trunk in (encoder.trunk, *imagenet.PACKAGES):
        if imagenet.source(trunk):
            return EncoderConfig(trunk=trunk, temporal=encoder.temporal, pool=encoder.pool)
    return None
