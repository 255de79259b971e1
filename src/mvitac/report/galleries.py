"""Pictures of features: a 2D map coloured by label, rows that are confused, and a gallery of cross-modal retrieval.

Shapes: features [N, D] of the rows shown; L2-normalised embeddings in the space that both modalities share [N, E].
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from markupsafe import Markup
from sklearn.decomposition import PCA
from sklearn.manifold import TSNE
from torch import Tensor

from mvitac.evaluation import diagnostics
from mvitac.evaluation.features import features, sample
from mvitac.evaluation.retrieval import shared_space
from mvitac.report import figures
from mvitac.report.html import blocks as html
from mvitac.report.html import picture
from mvitac.report.sections import Study

NUM_MAP, NUM_QUERIES, NUM_FOUND = 1500, 8, 5


class Query(NamedTuple):
    """A query row, the rank of its own group (1 = first), and the groups found first. Rows are those of test.

    A group is shown by its row nearest to the query, and is right, same class or wrong.
    """

    row: int
    rank: int
    found: list[tuple[int, str]]


def nearest_groups(
    query: Tensor, gallery: Tensor, groups: Tensor, labels: np.ndarray, rows: Sequence[int], num: int = NUM_FOUND
) -> list[Query]:
    """Find for each of ``rows`` the ``num`` groups with the nearest mean ``gallery`` embedding, as retrieval is scored.

    ``query`` and ``gallery`` [N, E] are embeddings of the two modalities. ``groups`` [N] are numbered from 0. Rows with
    label -1 are unlabelled and never "same class".
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
            hits.append((shown, "right" if group == own else "same class" if same else "wrong"))
        found.append(Query(int(row), int(ranks[row]) + 1, hits))
    return found


def embed_2d(values: np.ndarray) -> np.ndarray:
    """Map features [N, D] to [N, 2]: PCA to 50 dimensions, then t-SNE. Deterministic."""
    num = min(50, *values.shape)
    reduced = PCA(num, random_state=0).fit_transform(values)
    perplexity = min(30.0, (len(values) - 1) / 3)
    return TSNE(perplexity=perplexity, init="pca", random_state=0).fit_transform(reduced)


def feature_maps(study: Study) -> list[Markup]:
    """A map per modality, of the first run's features."""
    split, rows = study.rows()
    rows = sample(rows, NUM_MAP)
    if len(rows) < 8:
        return []
    first = next(iter(study.pack.spec.tasks), None)
    labels, names, by = study.labels(rows), first.classes if first else (), f" by {first.name}" if first else ""
    drawn = []
    for modality in study.pack.spec.modalities:
        points = embed_2d(features(study.runs[0].model, study.pack, modality, rows))
        drawing = figures.feature_map(modality, points, labels, names)
        alt = f"t-SNE of the {modality} features of {len(rows)} {split} rows{by}"
        drawn.append(study.figure(f"map {modality}", drawing, alt))
    intro = (
        f"{len(rows)} {split} rows{by}; features of {study.runs[0].path.name}, by PCA to 50 dimensions and t-SNE."
        " Near points are similar; distances between far clusters mean nothing."
    )
    return [html.paragraph(intro), html.grid(drawn, "grid large")]


def nearest_rows(values: np.ndarray, groups: np.ndarray, num: int = NUM_FOUND) -> np.ndarray:
    """The ``num`` rows of other ``groups`` [N] whose ``values`` [N, D] are nearest by cosine, of each row: [N, num]."""
    unit = values / np.maximum(np.linalg.norm(values, axis=1, keepdims=True), 1e-12)
    similarity = np.where(groups[:, None] == groups, -np.inf, unit @ unit.T)
    return np.argsort(-similarity, axis=1, kind="stable")[:, :num]


def mistakes(study: Study) -> list[Markup]:
    """Random rows whose nearest rows have another class, with these; without any labels, random rows."""
    split, rows = study.rows()
    rows = sample(rows, NUM_MAP)
    groups, labels = study.pack.column("group")[rows].astype(str), study.labels(rows)
    if len(rows) - np.unique(groups, return_counts=True)[1].max() < NUM_FOUND:
        return []  # too few rows of other groups
    halves, known = [], bool((labels >= 0).any())
    for modality in study.pack.spec.modalities:
        near = nearest_rows(features(study.runs[0].model, study.pack, modality, rows), groups)
        same = labels[near] == labels[:, None]
        asked = np.flatnonzero((labels >= 0) & (same.sum(1) <= NUM_FOUND // 2) if known else labels < 0)
        shown = []
        for at in sample(asked, NUM_QUERIES).tolist():
            kinds = ("" if labels[i] < 0 else "same class" if labels[i] == labels[at] else "other" for i in near[at])
            found = list(zip(rows[near[at]].tolist(), kinds, strict=True))
            shown.append(_strip(study, (modality, modality), int(rows[at]), str(groups[at]), found))
        halves.append(html.card(f"{modality}: {len(asked)} of {len(rows)} rows" if known else modality, shown))
    by, tasks, name = study.pack.spec.group_by, study.pack.spec.tasks, study.runs[0].path.name
    whose = f" whose five nearest rows are mostly of another {tasks[0].name}" if known else ""
    intro = (
        f"{split} rows{whose}, drawn at random (seed 0). Left: the row. Then, best first, the five rows of other {by}s"
        f" whose features of the same modality are nearest ({name})."
    )
    return [html.paragraph(intro[0].upper() + intro[1:]), html.grid(halves, "queries")]


_SHOWN = {
    "": ("", ""),
    "other": ("wrong", "\u2715 another class"),
    "right": ("right", "\u2713 right"),
    "same class": ("same", "\u2248 same class"),
    "wrong": ("wrong", "\u2715 wrong"),
}


def gallery(study: Study) -> list[Markup]:
    """Random queries in both directions with the five groups found first, each marked by a word and a colour."""
    run = next((run for run in study.runs if len(run.model.projectors) == 2), None)
    split, rows = study.rows()
    if run is None or split != "test" or not study.result["retrieval"]:
        return []  # without a score, as of a single test group, a gallery proves nothing
    z = shared_space(run.model, study.pack, rows)
    names = study.pack.column("group")[rows].astype(str)
    groups = torch.from_numpy(np.unique(names, return_inverse=True)[1])
    labels = study.labels(rows)
    queries, by, tasks = sample(np.arange(len(rows)), NUM_QUERIES), study.pack.spec.group_by, study.pack.spec.tasks
    halves = []
    for asked, searched in (("touch", "vision"), ("vision", "touch")):
        found = nearest_groups(z[asked], z[searched], groups, labels, queries.tolist())
        shown = []
        for query in found:
            rank = f"its {by} has rank {query.rank} of {int(groups.max()) + 1}"
            hits = [(rows[row], kind) for row, kind in query.found]
            shown.append(_strip(study, (asked, searched), rows[query.row], rank, hits))
        halves.append(html.card(f"{asked} → {searched}", shown))
    intro = (
        f"{len(queries)} test rows drawn at random (seed 0). Left: the query. Then, best first, the five {by}s whose mean"
        f" embedding in the other modality is nearest ({run.source}, {run.path.name})."
        + (f" Right: the same {by}. Same class: another {by} with the same {tasks[0].name}." if tasks else "")
    )
    return [html.paragraph(intro), html.grid(halves, "queries")]


def _strip(study: Study, senses: tuple[str, str], row: int, text: str, found: Sequence[tuple[int, str]]) -> Markup:
    """The picture of ``row`` in the first of ``senses``, with ``text``, and the rows ``found`` in the second."""
    image, name = _picture(study, senses[0], row)
    cells = [html.cell("asked", image, "", f"{name}; {text}")]
    for other, kind in found:
        css, mark = _SHOWN[kind]
        image, name = _picture(study, senses[1], other)
        cells.append(html.cell(css, image, mark, name))
    return html.grid(cells, "query")


def _picture(study: Study, modality: str, row: int) -> tuple[Markup, str]:
    pack, label = study.pack, study.labels(np.array([row]))[0]
    group = str(pack.column("group")[row])
    name = pack.spec.tasks[0].classes[label] if label >= 0 else group
    alt = f"{modality} of {pack.spec.group_by} {group} ({name})"
    return picture(pack.images[modality][row], alt), figures.shorten(name, 24)
