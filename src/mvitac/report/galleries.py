"""Features to look at: a plane of them coloured by label, and what random queries find in the other modality.

Shapes: features [N, D] of the rows looked at; embeddings in the space both modalities share [N, E], L2-normalised.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from sklearn.decomposition import PCA
from sklearn.manifold import TSNE
from torch import Tensor

from mvitac.evaluation import diagnostics
from mvitac.evaluation.features import features, sample
from mvitac.report import figures, html
from mvitac.report.sections import Study

NUM_MAP, NUM_QUERIES, NUM_FOUND = 1500, 8, 5


@dataclass(frozen=True)
class Found:
    """One retrieved group, shown by its row most like the query; rows count within the test rows."""

    row: int
    mark: Literal["right", "same class", "wrong"]


@dataclass(frozen=True)
class Query:
    """A query row, the rank (1 = first) of its own group, and the first groups found."""

    row: int
    rank: int
    found: tuple[Found, ...]


def nearest_groups(
    query: Tensor, gallery: Tensor, groups: Tensor, labels: np.ndarray, rows: Sequence[int], num: int = NUM_FOUND
) -> list[Query]:
    """For each of ``rows`` the ``num`` groups whose mean ``gallery`` embedding is nearest, just as retrieval is scored.

    ``query`` and ``gallery`` [N, E]; ``groups`` [N] numbered 0 .. G-1; ``labels`` [N], -1 = none, never "same class".
    """
    similarity = query @ diagnostics.group_means(gallery, groups).T  # [N, G]
    ranks = diagnostics.retrieval_ranks(query, gallery, groups)
    found = []
    for row in rows:
        own = int(groups[row])
        losing_ties = (np.arange(similarity.shape[1]) == own).astype(int)  # as in retrieval_ranks
        order = np.lexsort((losing_ties, -similarity[row].numpy()))[:num]
        hits = []
        for group in order:
            members = torch.nonzero(groups == int(group))[:, 0]
            shown = int(members[(gallery[members] @ query[row]).argmax()])
            same = labels[shown] == labels[row] and labels[row] >= 0
            hits.append(Found(shown, "right" if group == own else "same class" if same else "wrong"))
        found.append(Query(int(row), int(ranks[row]) + 1, tuple(hits)))
    return found


def embed_2d(values: np.ndarray) -> np.ndarray:
    """Features [N, D] on a plane [N, 2]: PCA to 50 dimensions, then t-SNE; the same picture every time."""
    num = min(50, *values.shape)
    reduced = PCA(num, random_state=0).fit_transform(values)
    perplexity = min(30.0, (len(values) - 1) / 3)
    return TSNE(perplexity=perplexity, init="pca", random_state=0).fit_transform(reduced)


def feature_maps(study: Study) -> str:
    """A plane per modality, of the first run's features."""
    split, rows = study.rows()
    rows = sample(rows, NUM_MAP)
    if len(rows) < 8:
        return ""
    task = study.pack.spec.tasks[0] if study.pack.spec.tasks else None
    drawn = []
    for modality in study.pack.spec.modalities:
        points = embed_2d(features(study.runs[0].model, study.pack, modality, rows))
        drawing = figures.feature_map(modality, points, study.labels(rows), task.classes if task else ())
        alt = f"t-SNE of the {modality} features of {len(rows)} {split} rows" + (f" by {task.name}" if task else "")
        drawn.append(study.figure(f"map {modality}", drawing, alt))
    by = f", by {task.name}" if task else ""
    intro = (
        f"{len(rows)} {split} rows{by}; features of {study.runs[0].path.name}, by PCA to 50 dimensions and t-SNE."
        " Near means alike; distances between far clumps mean nothing."
    )
    return html.paragraph(intro) + html.grid(drawn, "grid large")


_SHOWN = {
    "right": ("right", "\u2713 right"),
    "same class": ("same", "\u2248 same class"),
    "wrong": ("wrong", "\u2715 wrong"),
}


def gallery(study: Study) -> str:
    """Random queries in both directions with the five groups found first, each marked by words and colour."""
    run = next((run for run in study.runs if len(run.model.projectors) == 2), None)
    split, rows = study.rows()
    if run is None or split != "test":
        return ""
    model, pack = run.model, study.pack
    device = next(model.parameters()).device
    z = {
        m: model.project(m, torch.from_numpy(features(model, pack, m, rows, for_heads=True)).to(device)).cpu()
        for m in ("touch", "vision")
    }
    names = pack.column("group")[rows].astype(str)
    groups = torch.from_numpy(np.unique(names, return_inverse=True)[1])
    labels = study.labels(rows)
    classes: tuple[str, ...] = pack.spec.tasks[0].classes if pack.spec.tasks else ()
    chosen = sample(np.arange(len(rows)), NUM_QUERIES)
    by, halves = pack.spec.group_by, []

    def shown(modality: str, row: int) -> tuple[str, str]:
        name = str(classes[labels[row]] if labels[row] >= 0 else names[row])
        image = html.picture(pack.images[modality][rows[row]], f"{modality} of {by} {names[row]} ({name})")
        return image, figures.shorten(name, 24)

    for asked, searched in (("touch", "vision"), ("vision", "touch")):
        blocks = []
        for query in nearest_groups(z[asked], z[searched], groups, labels, chosen.tolist()):
            image, name = shown(asked, query.row)
            cells = [
                html.cell("asked", image, "", f"{name}; its {by} is at rank {query.rank} of {int(groups.max()) + 1}")
            ]
            for found in query.found:
                css, mark = _SHOWN[found.mark]
                image, name = shown(searched, found.row)
                cells.append(html.cell(css, image, mark, name))
            blocks.append(f'<div class="query">{"".join(cells)}</div>')
        halves.append(f'<div class="card"><h3>{asked} → {searched}</h3>{"".join(blocks)}</div>')
    intro = (
        f"{len(chosen)} test rows drawn at random (seed 0), not picked; left the query, then the five {by}s whose mean"
        f" embedding in the other modality is nearest, best first ({run.source}, {run.path.name})."
        + (f" Right: the same {by}. Same class: another one of the same {pack.spec.tasks[0].name}." if classes else "")
    )
    return html.paragraph(intro) + f'<div class="queries">{"".join(halves)}</div>'
