"""Pictures of rows that the features confuse."""

from collections.abc import Sequence

import numpy as np
from markupsafe import Markup

from mvitac.evaluation.features import features, sample
from mvitac.report import figures
from mvitac.report.html import blocks as html
from mvitac.report.html import picture
from mvitac.report.sections import Study

NUM_ROWS, NUM_QUERIES, NUM_FOUND = 1500, 8, 5


def nearest_rows(values: np.ndarray, groups: np.ndarray, num: int = NUM_FOUND) -> np.ndarray:
    """The ``num`` rows of other ``groups`` [N] whose ``values`` [N, D] are nearest by cosine, of each row: [N, num]."""
    unit = values / np.maximum(np.linalg.norm(values, axis=1, keepdims=True), 1e-12)
    similarity = np.where(groups[:, None] == groups, -np.inf, unit @ unit.T)
    return np.argsort(-similarity, axis=1, kind="stable")[:, :num]


def mistakes(study: Study) -> list[Markup]:
    """Random rows whose nearest rows have another class, with these; without any labels, random rows."""
    split, rows = study.rows()
    rows = sample(rows, NUM_ROWS)
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
            shown.append(_strip(study, modality, int(rows[at]), str(groups[at]), found))
        halves.append(html.card(f"{modality}: {len(asked)} of {len(rows)} rows" if known else modality, shown))
    by, tasks, name = study.pack.spec.group_by, study.pack.spec.tasks, study.runs[0].path.name
    whose = f" whose five nearest rows are mostly of another {tasks[0].name}" if known else ""
    intro = (
        f"{split} rows{whose}, drawn at random (seed 0). Left: the row. Then, best first, the five rows of other {by}s"
        f" whose features of the same modality are nearest ({name})."
    )
    return [html.paragraph(intro[0].upper() + intro[1:]), html.grid(halves, "queries")]


_SHOWN = {"": ("", ""), "other": ("wrong", "\u2715 another class"), "same class": ("same", "\u2248 same class")}


def _strip(study: Study, modality: str, row: int, text: str, found: Sequence[tuple[int, str]]) -> Markup:
    """The picture of ``row``, with ``text``, and the rows ``found``."""
    image, name = _picture(study, modality, row)
    cells = [html.cell("asked", image, "", f"{name}; {text}")]
    for other, kind in found:
        css, mark = _SHOWN[kind]
        image, name = _picture(study, modality, other)
        cells.append(html.cell(css, image, mark, name))
    return html.grid(cells, "query")


def _picture(study: Study, modality: str, row: int) -> tuple[Markup, str]:
    pack, label = study.pack, study.labels(np.array([row]))[0]
    group = str(pack.column("group")[row])
    name = pack.spec.tasks[0].classes[label] if label >= 0 else group
    alt = f"{modality} of {pack.spec.group_by} {group} ({name})"
    return picture(pack.images[modality][row], alt), figures.shorten(name, 24)
