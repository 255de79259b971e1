"""What every probe stands beside: the commonest class, pixels, the image's border, the dataset's own, an untrained trunk.

A score says something only by how far it is above these, on the same rows and by the same probe.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F

from mvitac.data.pack import Pack
from mvitac.data.spec import DataSpec, Task
from mvitac.evaluation.probe import cross_modal, parts, probe_all, probe_features, probe_model, score_rows
from mvitac.model import fresh
from mvitac.nn.encoders import SCRATCH
from mvitac.run import Run
from mvitac.system.processes import in_threads
from mvitac.system.progress import work

CONTROLS = ("imagenet", "untrained", "pixels", "border", "majority")
"""Their names, from the strongest idea to the weakest; the data's own come before the last."""


def thumbnails(pack: Pack, modality: str, rows: np.ndarray, side: int = 8) -> np.ndarray:
    """Control "pixels": the image averaged to side x side, flattened [len(rows), side * side * C]."""
    images = torch.from_numpy(pack.images[modality][rows]).permute(0, 3, 1, 2).float() / 255
    return F.adaptive_avg_pool2d(images, side).flatten(1).numpy()


def borders(pack: Pack, modality: str, rows: np.ndarray, side: int = 16, width: int = 2) -> np.ndarray:
    """Control "border": only the outer ring of a side x side thumbnail, where hardly any contact is ever seen."""
    ring = np.ones((side, side), bool)
    ring[width:-width, width:-width] = False
    pixels = thumbnails(pack, modality, rows, side).reshape(len(rows), -1, side, side)
    return pixels[:, :, ring].reshape(len(rows), -1)


def controls_of(
    runs: Sequence[Run],
    pack: Pack,
    tasks: Sequence[Task],
    modalities: Sequence[str],
    probes: Sequence[str],
    imagenet: Path | None = None,
    specs: Sequence[DataSpec] = (),
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Records of every control beside ``runs``, and the retrieval of those that have a shared space.

    Trunks are probed by each of ``probes``, the rest linearly; ``imagenet`` is a file of weights for one more trunk.
    ``specs`` are what the runs were trained on, where that is not ``pack``.
    """
    records: list[dict[str, Any]] = []
    retrieval: list[dict[str, Any]] = []

    def add(source: str, seed: int | None, found: list[dict[str, Any]]) -> None:
        records.extend({"source": source, "seed": seed, **record} for record in found)

    for task in tasks:
        for name, record in _without_images(pack, task):
            add(name, None, [record])

    def pixels(modality: str, rows: np.ndarray) -> np.ndarray:
        names = pack.spec.modalities if modality == "both" else (modality,)
        return np.concatenate([thumbnails(pack, m, rows) for m in names], axis=1)

    starts, weights = starts_of(runs, specs or [pack.spec] * len(runs)), start_weights(runs, imagenet)
    num_trunks = len(probes) * (len(starts) + len(weights))
    num = len(tasks) * (len(modalities) * (1 + num_trunks) + ("touch" in modalities))
    with work("fitting probes of the controls", num, "probes"):
        add("pixels", None, probe_all(pixels, pack, tasks, modalities, ["linear"], 0))
        if "touch" in modalities:
            ring = probe_all(lambda m, rows: borders(pack, m, rows), pack, tasks, ["touch"], ["linear"], 0)
            add("border", None, ring)

        # The trunk before training, once for each seed and architecture among the runs; then the trunk they started from.
        untrained = [
            fresh(_scratch(run), spec, pack.size) for run, spec in starts
        ]  # one by one: threads share a generator
        scored = in_threads(
            lambda model: (probe_model(model, pack, tasks, modalities, probes), cross_modal(model, pack)), untrained
        )
        for (run, _), (found, ranked) in zip(starts, scored, strict=True):
            add("untrained", run.seed, found)
            retrieval += [{"source": "untrained", "seed": run.seed, **r} for r in ranked]
        for name in weights:
            run, spec = starts[0]
            start = fresh(replace(run, encoder=replace(run.encoder, weights=name)), spec, pack.size)
            add("imagenet", None, probe_model(start, pack, tasks, modalities, probes))
    return records, retrieval


def _without_images(pack: Pack, task: Task) -> Iterator[tuple[str, dict[str, Any]]]:
    """The commonest class, and the dataset's own columns, by name."""
    rows = parts(pack, task)
    everything = np.concatenate([rows.train, rows.val, rows.test])
    labels = pack.column(f"label_{task.name}").astype(int)
    common = np.bincount(labels[np.concatenate([rows.train, rows.val])], minlength=len(task.classes)).argmax()
    constant = np.eye(len(task.classes))[np.full(len(rows.test), common)]
    own = {"task": task.name, "modality": "none", "probe": "linear"}
    yield "majority", {**own, **score_rows(pack, task, rows.test, constant)}
    for name, columns in pack.spec.controls.items():
        x = np.stack([pack.column(column)[everything].astype(float) for column in columns], axis=1)
        yield name, {**own, **probe_features(x, pack, task, rows, "linear", 0)}


def starts_of(runs: Sequence[Run], specs: Sequence[DataSpec]) -> list[tuple[Run, DataSpec]]:
    """The runs whose trunks before training are the controls, with what each was trained on: one of each seed, trunk and
    side, the first that has all modalities and heads into a shared space; further ones for modalities that it lacks."""

    def parts_of(run: Run, spec: DataSpec) -> tuple[set[str], int]:
        with torch.device("meta"):
            method = run.method.build(spec, _scratch(run).encoder)
        return set(method.encoders()), len(method.projectors())

    built = [(run, spec, *parts_of(run, spec)) for run, spec in zip(runs, specs, strict=True)]
    built.sort(key=lambda each: (len(each[2]), each[3]), reverse=True)
    found: list[tuple[Run, DataSpec]] = []
    covered: dict[tuple[int, str, int], set[str]] = {}
    for run, spec, modalities, _ in built:
        known = covered.setdefault((run.seed, run.encoder.trunk, run.augment.eval_size), set())
        if not modalities <= known:
            known |= modalities
            found.append((run, spec))
    return found


def _scratch(run: Run) -> Run:
    return replace(run, encoder=replace(run.encoder, weights=SCRATCH))


def start_weights(runs: Sequence[Run], imagenet: Path | None) -> list[str]:
    """The pre-trained weights to probe as they were: those that ``runs`` started from, and ``imagenet``."""
    weights = {str(imagenet)} if imagenet else set()
    return sorted(weights | {run.encoder.weights for run in runs if run.encoder.weights != SCRATCH})
