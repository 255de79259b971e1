"""Pictures of features: a 2D map coloured by label, and a gallery of cross-modal retrieval.

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


_SHOWN = {
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
    queries = sample(np.arange(len(rows)), NUM_QUERIES)
    halves = []
    for asked, searched in (("touch", "vision"), ("vision", "touch")):
        found = nearest_groups(z[asked], z[searched], groups, labels, queries.tolist())
        shown = [_query(study, rows, asked, searched, query, int(groups.max()) + 1) for query in found]
        halves.append(html.card(f"{asked} → {searched}", shown))
    by, tasks = study.pack.spec.group_by, study.pack.spec.tasks
    intro = (
        f"{len(queries)} test rows drawn at random (seed 0). Left: the query. Then, best first, the five {by}s whose mean"
        f" embedding in the other modality is nearest ({run.source}, {run.path.name})."
        + (f" Right: the same {by}. Same class: another {by} with the same {tasks[0].name}." if tasks else "")
    )
    return [html.paragraph(intro), html.grid(halves, "queries")]


def _query(study: Study, rows: np.ndarray, asked: str, searched: str, query: Query, num_groups: int) -> Markup:
    image, name = _picture(study, asked, rows[query.row])
    rank = f"its {study.pack.spec.group_by} has rank {query.rank} of {num_groups}"
    cells = [html.cell("asked", image, "", f"{name}; {rank}")]
    for row, kind in query.found:
        css, mark = _SHOWN[kind]
        image, name = _picture(study, searched, rows[row])
        cells.append(html.cell(css, image, mark, name))
    return html.grid(cells, "query")


def _picture(study: Study, modality: str, row: int) -> tuple[Markup, str]:
    pack, label = study.pack, study.labels(np.array([row]))[0]
    group = str(pack.column("group")[row])
    name = pack.spec.tasks[0].classes[label] if label >= 0 else group
    alt = f"{modality} of {pack.spec.group_by} {group} ({name})"
    return picture(pack.images[modality][row], alt), figures.shorten(name, 24)
