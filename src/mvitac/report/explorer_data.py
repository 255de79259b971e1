"""The data behind the explorer: a run's features in 2D, their nearest neighbours, and mistakes.

Shapes: N rows of the pack, D features.
"""

import json
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from matplotlib import colormaps, colors

from mvitac.data.images import side_by_side
from mvitac.data.pack import Pack
from mvitac.deploy.publish import with_probes
from mvitac.deploy.search import nearest
from mvitac.evaluation.features import features, fitting, sample
from mvitac.model import Model
from mvitac.nn.linear_probe import ProbeInfo
from mvitac.report.palette import COLOURS, MAP_HUES

LEVELS = 32  # number of colours between the lowest and the highest value
RAMP = [colors.to_hex(found) for found in colormaps["viridis"](np.linspace(0.0, 0.92, LEVELS))]  # seen on a light page


class ExplorerData:
    """One run: pack rows ``rows`` [N], unit features ``x[modality]`` [N, D], predictions ``guess[task]`` [N]."""

    def __init__(self, model: Model, pack: Pack, *, limit: int = 20_000) -> None:
        """Compute features of at most ``limit`` random rows that have all images; fit probes if the model has none."""
        names = fitting(model, pack)
        self.model, self.pack = with_probes(model, pack), pack
        whole = np.flatnonzero(np.all([pack.has(m) for m in names], axis=0))
        if not len(whole):
            raise ValueError(f"{pack.path} has no row with {' and '.join(names)}: there is nothing to show")
        self.rows = sample(whole, limit)
        raw = {m: features(model, pack, m, self.rows) for m in names}
        self.x = {m: _unit(f) for m, f in raw.items()}
        self.modalities = (*raw, *(["both"] if len(raw) == 2 else []))
        self.split = pack.column("split")[self.rows].astype(str)
        self.labels = {t.name: pack.column(f"label_{t.name}")[self.rows].astype(int) for t in pack.spec.tasks}
        self.classes: dict[str, tuple[str, ...]] = {t.name: t.classes for t in pack.spec.tasks}
        self.values: dict[str, np.ndarray] = {}  # target and its unit -> [N]; NaN = not measured
        for task in pack.spec.values:
            for target, found in zip(task.targets, pack.values(task)[self.rows].T, strict=True):
                self.values[f"{target.name} ({target.unit})"] = found
        self.guess: dict[str, np.ndarray] = {}
        for task in tuple(self.classes):
            probe = self.model.probes.get(f"{task}.{self.modalities[-1]}")
            if probe and isinstance(probe.info, ProbeInfo):
                joined = np.concatenate([raw[m] for m in probe.info.modalities], axis=1)
                # Match classes by name: the probe may be of other data.
                known = probe.info.classes
                names = self.classes[task] = tuple(dict.fromkeys((*self.classes[task], *known)))
                found = probe(torch.from_numpy(joined)).argmax(1).numpy()
                self.guess[task] = np.array([names.index(name) for name in known])[found]
        self._planes: dict[str, tuple[np.ndarray, np.ndarray]] = {}

    def plane(self, modality: str) -> np.ndarray:
        """The first two principal components of the unit features, scaled to [0, 1]: [N, 2]."""
        return self._components(modality)[0]

    def axes(self, modality: str) -> list[str]:
        """What the two axes of the plane are, with their shares of the variance."""
        names = "vision and touch" if modality == "both" else modality
        return [
            f"principal component {number} of {names} ({100 * share:.0f} % of the variance)"
            for number, share in enumerate(self._components(modality)[1].tolist(), 1)
        ]

    def _components(self, modality: str) -> tuple[np.ndarray, np.ndarray]:
        """The plane [N, 2], and the share of the variance along each of its axes [2]."""
        if modality not in self._planes:
            x = np.concatenate([self.x[m] for m in self.x], axis=1) if modality == "both" else self.x[modality]
            x = x - x.mean(0)
            variances, vectors = np.linalg.eigh(x.T @ x)
            xy = x @ vectors[:, -2:][:, ::-1]
            low, high = np.percentile(xy, [0.5, 99.5], axis=0)  # ignore outliers
            plane = np.clip((xy - low) / np.maximum(high - low, 1e-9), 0, 1)
            self._planes[modality] = plane, variances[-2:][::-1] / max(variances.sum(), 1e-12)
        return self._planes[modality]

    def shown(self, split: str, task: str | None, *, mistakes: bool = False) -> np.ndarray:
        """Indices into ``rows`` of one split or "all"; only the mistakes of ``task`` if ``mistakes``."""
        keep = np.ones(len(self.rows), bool) if split == "all" else self.split == split
        if mistakes and task in self.guess:
            keep &= (self.labels[task] >= 0) & (self.guess[task] != self.labels[task])
        return np.flatnonzero(keep)

    def points(self, modality: str, colour: str, split: str, task: str | None, *, mistakes: bool = False) -> str:
        """The map as JSON for scatter.js; ``colour`` is "label" or "split". A target is coloured by its value."""
        index = self.shown(split, task, mistakes=mistakes)
        if task in self.values and colour != "split":
            return self._by_value(modality, index, task)
        if colour == "split" or task is None:
            names: Sequence[str] = sorted(set(self.split))
            values = np.searchsorted(names, self.split)
        else:
            names = (*self.classes[task], "unlabelled")
            values = np.where(self.labels[task] < 0, len(names) - 1, self.labels[task])
        used, counts = np.unique(values[index], return_counts=True)
        largest = [u for u in np.argsort(-counts, kind="stable") if names[used[u]] != "unlabelled"][: len(MAP_HUES)]
        first = [names[used[u]] for u in sorted(largest)]
        legend: dict[str, Any] = {"legend": [str(names[v]) for v in used.tolist()], "coloured": first}
        legend |= {"hues": [COLOURS[hue] for hue in MAP_HUES], "by": task if colour == "label" else colour}
        return self._json(modality, index, np.searchsorted(used, values[index]), **legend)

    def _by_value(self, modality: str, index: np.ndarray, target: str) -> str:
        """The map coloured by the values of ``target``; "bar" is the range of the colours. 1 % at either end share one."""
        values = self.values[target]
        low, high = np.nanpercentile(values, [1, 99]).tolist()
        share = np.clip((values[index] - low) / max(high - low, 1e-12), 0, 1)
        levels = [str(level) for level in range(LEVELS)]
        group = np.where(np.isnan(share), LEVELS, np.nan_to_num(share) * (LEVELS - 1)).round()
        legend = {"legend": [*levels, "not measured"], "coloured": levels, "hues": RAMP, "by": target}
        return self._json(modality, index, group, **legend, bar=[f"{low:.3g}", f"{high:.3g}", target])

    def _json(self, modality: str, index: np.ndarray, group: np.ndarray, **legend: Any) -> str:
        """The points ``index``, each with the number of its group in the legend."""
        x, y = self.plane(modality)[index].T.round(4).tolist()
        points = {"x": x, "y": y, "group": group.astype(int).tolist(), "row": index.tolist()}
        return json.dumps({**points, **legend, "gray": COLOURS["grey4"], "axes": self.axes(modality)})

    def neighbours(self, queries: np.ndarray, modality: str, k: int, without: int = -1) -> list[tuple[int, float]]:
        """(index, cosine) of the k rows nearest to a unit vector [1, D], without row ``without``."""
        index, scores = nearest(self.x[modality], queries, k + 1)
        pairs = zip(index[0].tolist(), scores[0].tolist(), strict=True)
        return [(i, s) for i, s in pairs if i != without][:k]

    def same_class(self, i: int, j: int, task: str | None) -> bool | None:
        """Whether rows ``i`` and ``j`` have the same label of ``task``; None where one has no label."""
        if task not in self.labels or self.labels[task][i] < 0 or self.labels[task][j] < 0:
            return None
        return bool(self.labels[task][i] == self.labels[task][j])

    def describe(self, i: int) -> str:
        """One line about row ``i``: id, split, labels, wrong predictions, and values."""
        row = int(self.rows[i])
        parts = [str(self.pack.table.column("id")[row]), str(self.split[i])]
        for task, labels in self.labels.items():
            if labels[i] >= 0:
                text = self.classes[task][labels[i]]
                if task in self.guess and self.guess[task][i] != labels[i]:
                    text += f" (probe: {self.classes[task][self.guess[task][i]]})"
                parts.append(text)
        parts += [f"{target} {found[i]:.3g}" for target, found in self.values.items() if np.isfinite(found[i])]
        return " · ".join(parts)

    def picture(self, i: int, modality: str) -> np.ndarray:
        """uint8 [S, S, 3], or [S, 2 S, 3] for two sensors."""
        return side_by_side(self.pack.images[modality][int(self.rows[i])])


def _unit(x: np.ndarray) -> np.ndarray:
    return (x / np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-12)).astype(np.float32)
