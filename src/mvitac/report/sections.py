"""Sections of the report: retrieval, training curves, confusion matrices. Each is a list of blocks, perhaps empty."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure

from mvitac.data.pack import Pack
from mvitac.evaluation.retrieval import MIN_GALLERY, retrieved_rows
from mvitac.evaluation.score_text import WORDS, headline
from mvitac.model import Model
from mvitac.report import figures, tables
from mvitac.report.figures import Line
from mvitac.report.html import HUES, MODALITY_HUES
from mvitac.report.html import blocks as html
from mvitac.run import Run
from mvitac.system.files import write_atomic


@dataclass(frozen=True)
class Finished:
    """A finished run: its record (run.json), log lines and model, and its name in the tables."""

    path: Path
    run: Run
    record: dict[str, Any]
    log: list[dict[str, Any]]
    model: Model
    source: str


@dataclass(frozen=True)
class Study:
    """Finished runs on one dataset, the result of ``probe_runs``, and the folder for figures."""

    runs: Sequence[Finished]
    pack: Pack
    result: dict[str, Any]
    out: Path
    files: dict[str, str] = field(default_factory=dict)  # of figures -> their names

    @property
    def sources(self) -> list[str]:
        """Names of the methods in the probe result. Every other source is a control."""
        return list(dict.fromkeys(run.source for run in self.runs))

    def rows(self) -> tuple[str, np.ndarray]:
        """The split to show and its rows: test, as scored by the first task and by retrieval, else another."""
        for split in ("test", "val", "train", "unlabelled"):
            if len(rows := retrieved_rows(self.pack, split)):
                return split, rows
        raise ValueError(f"no rows to show in {self.pack.path}: give a pack with samples")

    def labels(self, rows: np.ndarray) -> np.ndarray:
        """Labels of the first task [len(rows)]; -1 = unlabelled."""
        if not self.pack.spec.tasks:
            return np.full(len(rows), -1)
        return self.pack.column(f"label_{self.pack.spec.tasks[0].name}")[rows].astype(int)

    def figure(self, name: str, drawing: Figure, alt: str, caption: str = "") -> Markup:
        """Save ``drawing`` as a PNG in figures/ and return it as a block."""
        safe = "".join(c if c.isalnum() else "-" for c in name.lower()[:80])
        while self.files.setdefault(safe, name) != name:
            safe += "-2"
        write_atomic(self.out / "figures" / f"{safe}.png", lambda file: file.write(figures.to_png(drawing)))
        return html.figure(html.image(figures.to_svg(drawing), alt), caption)


def retrieval(study: Study) -> list[Markup]:
    """Recall of both directions, and what chance gives."""
    if not (found := study.result["retrieval"]):
        needs = f"a space that both modalities share and {MIN_GALLERY} test {study.pack.spec.group_by}s with both"
        return [html.paragraph(f"Not scored: it takes {needs}.")]
    by, num = study.pack.spec.group_by, found[0]["num_groups"]
    rows = [[row[0], row[1].replace("->", "→"), *row[2:]] for row in tables.retrieval_rows(found)]
    columns = ["", "query → found", *(f"{k} %" for k in tables.RETRIEVAL)]
    shown = html.table(columns, rows, muted={row[0] for row in rows} - set(study.sources), label="retrieval")
    intro = f"Given one image, find its {by} among {num}, each represented by its mean embedding in the other modality."
    return [html.paragraph(intro), shown]


_NOT_LOSS = ("step", "lr", "pairs_per_s", "loss", "eval")


def loss(study: Study) -> list[Markup]:
    """The total loss of every run, and the parts of each method's loss."""
    series = [(r, entries) for r in study.runs if (entries := [entry for entry in r.log if "loss" in entry])]
    if not series:
        return [html.paragraph("The runs left no log lines.")]
    hues = dict(zip(study.sources, itertools.cycle(HUES), strict=False))
    total = [Line(r.source, *_column(entries, "loss"), hues[r.source]) for r, entries in series]
    drawn = [study.figure("loss", figures.curves("loss", total), "Total loss over the steps")]
    for source in study.sources:
        drawn += _loss_parts(study, source, [(r, entries) for r, entries in series if r.source == source])
    seeds = " One line per seed." if len(study.runs) > len(study.sources) else ""
    intro = f"A falling loss alone proves nothing: read it with the next section.{seeds}"
    return [html.paragraph(intro), html.grid(drawn)]


def _loss_parts(study: Study, source: str, series: Sequence[tuple[Finished, list[dict[str, Any]]]]) -> list[Markup]:
    names = [name for name in series[0][1][0] if name not in _NOT_LOSS] if series else []
    if len(names) < 2:
        return []
    hues = dict(zip(names, itertools.cycle(HUES), strict=False))
    lines = [Line(name, *_column(entries, name), hue) for name, hue in hues.items() for _, entries in series]
    batch, caption, chance = series[0][0].run.batch_size, "", {}
    if set(names) <= {"vv", "tt", "vt", "tv"}:  # InfoNCE has a known chance level
        chance = {f"guessing (ln {batch})": math.log(batch)}
        caption = "vv and tt: within vision and within touch; vt and tv: across, query first."
    title = "parts of the loss" if len(study.sources) == 1 else f"parts of the loss, {source}"
    drawing = figures.curves(title, lines, chance)
    return [study.figure(f"loss parts {source}", drawing, f"{title} over the steps", caption)]


def _column(entries: list[dict[str, Any]], key: str) -> tuple[list[float], list[float]]:
    have = [entry for entry in entries if key in entry]
    # five digits, or float32 noise would set the axis of a constant curve
    return [entry["step"] for entry in have], [float(f"{entry[key]:.5g}") for entry in have]


def collapse(study: Study) -> list[Markup]:
    """What training measured on held-out groups: std, rank, linear probe, R@5."""
    drawn = []
    chances = [e["eval"]["chance R@5"] for r in study.runs for e in r.log if "chance R@5" in e.get("eval", {})]
    for title, keys, caption in _panels(study):
        lines = []
        for (key, (label, hue)), r in itertools.product(keys.items(), study.runs):
            steps, values = _column([{"step": e["step"], **e["eval"]} for e in r.log if "eval" in e], key)
            if steps:
                name = label if len(study.sources) == 1 else f"{label}, {r.source}"
                dash = figures.DASHES[study.sources.index(r.source) % len(figures.DASHES)]
                lines.append(Line(name, steps, values, hue, dash))
        if lines:
            chance = {"chance": chances[0]} if title == "retrieval R@5" and chances else {}
            drawing = figures.curves(title, lines, chance)
            drawn.append(study.figure(title, drawing, f"{title} over the steps. {caption}", caption))
    if not drawn:
        return []
    held_out = f"{study.pack.spec.group_by}s held out for this (split val)"
    where = held_out if len(study.pack.rows("val")) > 1 else "training rows (no val split)"
    said = [f"{r.source}, seed {r.run.seed}: {e['verdict']}." for r in study.runs for e in r.log if "verdict" in e]
    intro = f"Measured while training, on {where}. Dashed: the value at the start, before the first step."
    return [html.paragraph(intro), *map(html.paragraph, said), html.grid(drawn)]


def _panels(study: Study) -> list[tuple[str, dict[str, tuple[str, str]], str]]:
    """Title, curves (key in the log -> label, hue) and caption of each figure about collapse."""

    def each(name: str) -> dict[str, tuple[str, str]]:
        return {f"{m}/{name}": (m, hue) for m, hue in MODALITY_HUES.items()}  # a curve that no log has is left out

    across = {"vision->touch R@5": ("vision → touch", "green"), "touch->vision R@5": ("touch → vision", "purple")}
    probe = "Accuracy, or R2 of values; fitted on training rows, scored on held-out rows, never test."
    return [
        ("std of the features", each("std"), "About 1: spread out; 0: collapsed."),
        ("effective rank", each("rankme"), "RankMe; 1: collapsed, higher is richer."),
        *((f"linear probe, {task.name}", each(f"linear {task.name}"), probe) for task in study.pack.spec.all_tasks),
        ("retrieval R@5", across, "Own group among the first five, in the space both share."),
    ]


def confusions(study: Study) -> list[Markup]:
    """The first method's confusion matrix per task, on both modalities or its best one, summed over seeds."""
    source, drawn = study.sources[0], []
    for task, classes in study.result["classes"].items():
        if source not in {s for cells in study.result["summary"].get(task, {}).values() for s in cells}:
            continue
        modality = headline(study.result["summary"][task], source, study.sources)[0]
        wanted = {"task": task, "modality": modality, "source": source, "probe": study.result["records"][0]["probe"]}
        found = [r for r in study.result["records"] if all(r[k] == v for k, v in wanted.items())]
        counts = np.sum([r["confusion"] for r in found], axis=0)
        drawing = figures.confusion(f"{task}, {WORDS[modality]}", counts, classes)
        alt = f"Confusion matrix of {task}: rows are true classes, columns what the probe said"
        caption = f"{counts.sum() // len(found)} test rows{f', {len(found)} seeds added up' * (len(found) > 1)}."
        drawn.append(study.figure(f"confusion {task}", drawing, alt, caption))
    if not drawn:
        return []
    return [html.paragraph(f"Each row is a true class and sums to 100 % ({source})."), html.grid(drawn)]
