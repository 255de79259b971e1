"""Sections of the report about scores: every probe next to its controls, and predicted values against true ones."""

from typing import Any

from markupsafe import Markup

from mvitac.evaluation import score_text
from mvitac.evaluation.score_text import columns_of, error_text, percent, score_name, sources_of, with_interval
from mvitac.evaluation.scores import by_cell, summarise_again
from mvitac.report import figures, tables
from mvitac.report.html import MODALITY_HUES
from mvitac.report.html import blocks as html
from mvitac.report.sections import Study


def probe(study: Study) -> list[Markup]:
    """Bars per task, then every number; none if nothing is labelled."""
    summary, records = study.result["summary"], study.result["records"]
    if not summary:
        return []
    kinds: list[str] = list(dict.fromkeys(r["probe"] for r in records))  # the first one is that of the summary
    drawn = []
    for task, found in summary.items():
        groups = {m: {s: found[m][s] for s in sources_of(found) if s in found[m]} for m in columns_of(found)}
        lines = {name: cell["mean"] for name, cell in found.get("none", {}).items()}
        drawing = figures.bars(task, groups, lines, f"{score_name(found)} %, mean and 95 % interval")
        alt = f"Probe scores on {task}; the numbers are in the table below"
        drawn.append(study.figure(f"probe {task}", drawing, alt))
    numbers = _scores(study, summary)
    for kind in kinds[1:]:
        again = summarise_again(records, kind)
        names = " and ".join(dict.fromkeys(tables.probe_name(kind, score_name(cells)) for cells in again.values()))
        numbers.append(html.fold(f"The same by {names}", html.grid(_scores(study, again), "")))
    for task, modality, sources, classes in tables.classes_of(study.result):
        heads = ["class", "rows", "groups", *(f"{source}: precision / recall" for source in sources)]
        table = html.table(heads, tables.class_rows(classes, sources), label=f"{task}: classes")
        title = f"Every class of {task}, by {score_text.WORDS[modality]}: precision and recall (%)"
        numbers.append(html.fold(title, table))
    names = " or ".join(dict.fromkeys(tables.probe_name(kinds[0], score_name(found)) for found in summary.values()))
    by = study.pack.spec.group_by
    intro = f"A probe ({names}) on frozen features, scored on {tables.unseen_groups(by, records)}."
    intro += "".join(f" LEAK: {leak}." for leak in study.result.get("leaks", ()))
    if any(score_name(found) == "R2" for found in summary.values()):
        intro += (
            " Values are scored by R2, the share of the variance of the test rows that is predicted: 100 % is exact, 0 %"
            " is no better than their mean, and less is worse."
        )
    if {r["source"] for r in records} - set(study.sources):
        intro += " Grey bars are controls: the same probe on frozen ImageNet, untrained trunks, pixels and the border."
    return [html.paragraph(intro), html.grid(drawn), *numbers]


def _scores(study: Study, summary: dict[str, Any]) -> list[Markup]:
    parts = []
    for score in ("accuracy", "R2"):
        tasks = {task: found for task, found in summary.items() if score_name(found) == score}
        columns = [m for m in score_text.MODALITY_ORDER if any(m in columns_of(found) for found in tasks.values())]
        rows, muted = [], set()
        for task, found in tasks.items():
            order, about = sources_of(found), score_text.tested_on(found, study.pack.spec.group_by)
            rows += [[f"{task} ({about})"], *score_text.score_rows(found, columns)]
            muted |= set(order) - set(study.sources)
        if rows:
            parts.append(html.table([f"{score} %", *columns], rows, muted=muted, label=score))
        parts += [_target_table(study, task, found) for task, found in tasks.items() if score == "R2"]
    return parts


def _target_table(study: Study, task: str, found: dict[str, Any]) -> Markup:
    rows: list[list[str]] = []
    for target, source, cells in tables.target_rows(found):
        if [target] not in rows:
            rows.append([target])
        score = ("" if c is None else with_interval(c["mean"], c["low"], c["high"]) for c in cells)
        error = ("" if c is None else error_text(c) for c in cells)
        rows.append([source, *(text for pair in zip(score, error, strict=True) for text in pair)])
    heads = [head for m in columns_of(found) for head in (f"{m}: R2 %", "mean absolute error")]
    table = html.table([task, *heads], rows, muted={*sources_of(found)} - {*study.sources}, label=f"{task}: targets")
    return table + (html.paragraph(f"{clipped}.") if (clipped := score_text.clipped_text(found)) else "")


def values(study: Study) -> list[Markup]:
    """Predicted against true values of the first method, for each target."""
    records = study.result["records"]
    cells = by_cell(records, records[0]["probe"]) if records else {}
    drawn = []
    for task, found in study.result["summary"].items():
        if score_name(found) == "accuracy":
            continue
        modality, own, _ = score_text.headline(found, study.sources[0], study.sources)
        mine = cells[task, modality, study.sources[0]]
        for t, target in enumerate(own["targets"]):
            name = target["name"] if target["name"] == task else f"{task}: {target['name']}"
            hue, unit = MODALITY_HUES[modality], target["unit"]
            points = [pair for record in mine for pair in record["points"][t]]
            drawing = figures.predicted(f"{name}, {score_text.WORDS[modality]}", points, unit, hue)
            text = f"R2 {percent(target['mean'])} %, mean absolute error {error_text(target)}; {len(points)} test rows"
            text += f" of {len(mine)} seeds." if len(mine) > 1 else "."
            drawn.append(study.figure(f"predicted {name}", drawing, f"Predicted against true {name}. {text}", text))
    if not drawn:
        return []
    intro = f"A point is a test row ({study.sources[0]}). A flat cloud: the probe answers about the same for all."
    return [html.paragraph(intro), html.grid(drawn)]
