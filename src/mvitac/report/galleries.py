"""Pictures of rows that the features confuse."""

import numpy as np
from markupsafe import Markup

from mvitac.data.pack_table import SPLITS
from mvitac.deploy.search import unit
from mvitac.evaluation.features import features, sample
from mvitac.evaluation.retrieval import retrieved_rows
from mvitac.report import figures
from mvitac.report.html import blocks as html
from mvitac.report.html import picture
from mvitac.report.sections import Study

NUM_ROWS, NUM_QUERIES, NUM_FOUND = 1500, 8, 5


def nearest_rows(values: np.ndarray, groups: np.ndarray, num: int = NUM_FOUND) -> np.ndarray:
    """Of each of N rows, its nearest row by cosine of ``values`` [N, D] in each of the ``num`` nearest other ``groups``."""
    alike = np.where(groups[:, None] == groups, -np.inf, unit(values) @ unit(values).T)
    names, number = np.unique(groups, return_inverse=True)
    members = [np.flatnonzero(number == k) for k in range(len(names))]
    best = np.stack([own[alike[:, own].argmax(1)] for own in members], axis=1)  # [N, groups]
    found = np.take_along_axis(alike, best, axis=1)
    return np.take_along_axis(best, np.argsort(-found, axis=1, kind="stable")[:, :num], axis=1)  # the own group is last


def mistakes(study: Study) -> list[Markup]:
    """Random rows whose nearest row has another class, with the nearest; without any labels, random rows."""
    (split, shown), pack = study.rows(), study.pack
    known = bool((study.labels(np.arange(pack.num)) >= 0).any())
    rows = sample(retrieved_rows(pack, *SPLITS), NUM_ROWS)
    rows = np.union1d(shown := sample(shown, NUM_ROWS), rows) if known else rows
    groups, labels = pack.column("group")[rows].astype(str), study.labels(rows)
    num = min(NUM_FOUND, len(np.unique(groups)) - 1)
    halves, asked = [], np.isin(rows, shown)
    shared = [label for label in np.unique(labels) if len(np.unique(groups[labels == label])) > 1]
    for modality in pack.spec.modalities:
        near = nearest_rows(features(study.runs[0].model, pack, modality, rows), groups, num)
        wrong = asked & np.isin(labels, shared) & (labels >= 0) & (labels[near[:, :1]] != labels[:, None]).any(1)
        strips = []
        for at in sample(np.flatnonzero(wrong if known else asked), NUM_QUERIES).tolist():
            kinds = ("" if labels[i] < 0 else "same class" if labels[i] == labels[at] else "other" for i in near[at])
            pairs = zip(rows[near[at]].tolist(), kinds, strict=True)
            cells = [_cell(study, modality, other, *_SHOWN[kind]) for other, kind in pairs]
            cells.insert(0, _cell(study, modality, int(rows[at]), "asked", ""))
            strips.append(html.grid(cells, "query"))
        halves.append(html.card(f"{modality}: {wrong.sum()} of {len(shown)} rows" if known else modality, strips))
    by, name = pack.spec.group_by, study.runs[0].path.name
    which = f" whose nearest row of another {by} is of another {pack.spec.tasks[0].name}" if known else ""
    intro = f"{split.capitalize()} rows{which}, drawn at random (seed 0). Left: the row. Then, best first, the nearest"
    intro += f" row of each of the {num} nearest other {by}s of any split, by features of the same modality ({name})."
    return [html.paragraph(intro), html.grid(halves, "queries")]


_SHOWN = {"": ("", ""), "other": ("wrong", "\u2715 another class"), "same class": ("same", "\u2248 same class")}


def _cell(study: Study, modality: str, row: int, css: str, mark: str) -> Markup:
    pack, label = study.pack, study.labels(np.array([row]))[0]
    group = str(pack.column("group")[row])
    name = pack.spec.tasks[0].classes[label] if label >= 0 else group
    image = picture(pack.images[modality][row], f"{modality} of {pack.spec.group_by} {group} ({name})")
    return html.cell(css, image, mark, f"{figures.shorten(name, 24)}; {pack.column('id')[row]}")
