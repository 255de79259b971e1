"""Probe results as tables for a terminal 80 columns wide, and the rows that every table of results shares."""

import textwrap
from collections.abc import Iterator, Sequence
from typing import Any, TextIO

from tabulate import tabulate

from mvitac.evaluation import score_text
from mvitac.evaluation.intervals import MIN_GROUPS, interval, num_groups_of, paired_difference
from mvitac.evaluation.leaks import leak_mark
from mvitac.evaluation.score_text import columns_of, error_text, headline, percent, sources_of, with_interval
from mvitac.evaluation.scores import grouped, leaks_in

PROBE_NAMES = {
    "linear": "logistic regression",
    "paper": "the paper's probe",
    "knn": "20 nearest neighbours",
    "own": "the head that was trained with the encoders",
}
NUM_BESIDE = 3  # sources side by side in a table of classes
RETRIEVAL = ("R@1", "R@5", "R@10", "chance R@5")  # columns of a retrieval table, in percent


def unseen_groups(group_by: str, records: Sequence[dict[str, Any]]) -> str:
    """The test groups of ``records``: unseen ones, unless a source was trained on some of them or may have been."""
    return f"{'test' if leaks_in(records) else 'unseen'} {group_by}s"


def probe_name(kind: str, score: str) -> str:
    """The name of probe ``kind`` for a task with ``score`` (``scores.score_name``)."""
    if score == "R2" and kind in ("linear", "paper"):  # values have no probe of the paper: by_cell shows the linear one
        return "ridge regression"
    return PROBE_NAMES.get(kind, kind)


def print_summary(result: dict[str, Any], file: TextIO | None = None, *, probe: str = "linear") -> None:
    """Print one table per task: accuracy or R2 in percent, mean and 95 % interval. Values have a table of targets too."""
    trained, by, few = [], result["group_by"], 10
    for name, task in result["summary"].items():
        trained += [{"source": s, "seed": seed} for m in task.values() for s, v in m.items() for seed in v["seeds"]]
        modalities, score = columns_of(task), score_text.score_name(task)
        seeds = max((len(v["seeds"]) for m in task.values() for v in m.values()), default=0)
        few = min(v["groups"] for m in (*task.values(), {"": {"groups": few}}) for v in m.values())
        about = f"{probe_name(probe, score)}; {seeds} seed{'s' * (seeds != 1)}; {score_text.tested_on(task, by)}"
        title = f"{result['data']}: {name} ({about})"
        # LEAK on a line of its own, else the table is too wide.
        rows = [[cell.replace(" LEAK", "\nLEAK") for cell in row] for row in score_text.score_rows(task, modalities)]
        print(text_table(title, [f"{score} %", *modalities], rows).rstrip(), file=file)
        for line in score_text.verdicts(task):
            print(textwrap.fill(line, 80, subsequent_indent="  "), file=file)
        print(file=file)
        if score == "R2":
            rows, above = [], ""
            for target, source, cells in target_rows(task):
                scores = (f"{percent(cell['mean'])}, {error_text(cell)}" if cell else "" for cell in cells)
                rows.append([target * (target != above), source, *scores])
                above = target
            print(text_table(f"{name}: R2 % and mean absolute error", ["", "", *modalities], rows, words=2), file=file)
        if clipped := score_text.clipped_text(task):
            print(textwrap.fill(clipped, 80, subsequent_indent="  "), file=file)
    _print_notes(result, trained, file)
    if 1 < few < 10 and result.get("asked", {}).get("folds") == 0:  # of probe
        hint = f"hint: {few} test {by}s tell little: --folds {min(5, few)} tests every {by} no run learned from"
        print(textwrap.fill(hint, 80, subsequent_indent="  "), file=file)


def _print_notes(result: dict[str, Any], records: Sequence[dict[str, Any]], file: TextIO | None) -> None:
    said = f"95 % intervals: {score_text.covered(result['group_by'], records)}."
    print(textwrap.fill(said, 80, subsequent_indent="  "), file=file)
    for kind, key in (("note", "notes"), ("LEAK", "leaks")):
        for text in result.get(key, ()):
            print(textwrap.fill(f"{kind}: {text}", 80, subsequent_indent="  "), file=file)


def classes_of(result: dict[str, Any]) -> Iterator[tuple[str, str, list[str], list[dict[str, Any]]]]:
    """Task, headline modality, sources (methods, untrained, pixels) and classes (``scores.per_class``) of each task."""
    for task, found in result.get("per_class", {}).items():
        methods = score_text.methods_of(result["summary"][task])
        modality = headline(result["summary"][task], methods[0], methods)[0] if methods else "touch"
        if classes := found.get(modality):
            yield task, modality, [s for s in (*methods, "untrained", "pixels") if s in classes[0]["scores"]], classes


def class_rows(classes: Sequence[dict[str, Any]], sources: Sequence[str]) -> list[list[str]]:
    """Rows of class, its rows and groups, and "precision / recall" of each source in percent; "-" where there is none."""
    scores = [[" / ".join("-" if v is None else percent(v) for v in c["scores"][s]) for s in sources] for c in classes]
    return [[c["class"], str(c["rows"]), str(c["groups"]), *s] for c, s in zip(classes, scores, strict=True)]


def print_classes(result: dict[str, Any], file: TextIO | None = None) -> None:
    """Print precision and recall of each class, a table per task; of several methods in several tables."""
    if not (found := list(classes_of(result))):
        print("no task that was scored has classes", file=file)
    for task, modality, sources, classes in found:
        title = f"{task} by {score_text.WORDS[modality]}: precision / recall of each class, %"
        for start in range(0, len(sources), NUM_BESIDE):
            some = sources[start : start + NUM_BESIDE]
            rows = class_rows([{**c, "class": c["class"][:16]} for c in classes], some)
            print(text_table(title, ["class", "rows", "groups", *some], rows), file=file)


def target_rows(task: dict[str, Any]) -> list[tuple[str, str, list[dict[str, Any] | None]]]:
    """Target, source, and the source's scores of that target by modality (``columns_of``), of a task with values."""
    first, rows = next(cell for cells in task.values() for cell in cells.values()), []
    for t, target in enumerate(first["targets"]):
        for source in sources_of(task):
            cells = [task[m].get(source) or task.get("none", {}).get(source) for m in columns_of(task)]
            rows.append((target["name"], source, [cell["targets"][t] if cell else None for cell in cells]))
    return rows


def print_retrieval(result: dict[str, Any], file: TextIO | None = None) -> None:
    """Print cross-modal retrieval as one table, if the methods have a shared space."""
    if not result["retrieval"]:
        return
    unseen = unseen_groups(result["group_by"], result["retrieval"])
    columns = ("", "query -> found", *(f"{column} %" for column in RETRIEVAL))
    print(text_table(f"retrieval over {unseen}", columns, retrieval_rows(result["retrieval"]), words=2), file=file)


def retrieval_rows(records: Sequence[dict[str, Any]]) -> list[list[str]]:
    """Rows of source, direction and ``RETRIEVAL`` in percent, averaged over seeds."""
    rows = []
    for found in grouped(records, ("source", "direction")):
        mark = leak_mark(leaks_in(found))
        mean = {key: sum(record[key] for record in found) / len(found) for key in RETRIEVAL}
        mean["R@5"] = interval(found)[0]  # from its counts, so that it equals the mean of its interval
        *scores, chance = map(percent, mean.values())
        rows.append([found[0]["source"], found[0]["direction"], *(score + mark for score in scores), chance])
    return rows


def print_finetuning(result: dict[str, Any], file: TextIO | None = None) -> None:
    """Print the result of ``experiments.finetune``: a table per task, with a column for each share of the labels."""
    tasks: dict[str, dict[str, dict[float, list[dict[str, Any]]]]] = {}
    for record in result["records"]:
        cells = tasks.setdefault(record["task"], {}).setdefault(record["source"], {})
        cells.setdefault(record["fraction"], []).append(record)
    for task, cells in tasks.items():
        (_, ours), *others = cells.items()
        score = "R2" if "r2" in next(iter(ours.values()))[0] else "accuracy"
        columns = [f"{score} %", *(f"{f:g} % of {result['group_by']}s" for f in ours)]
        rows = []
        for source, found in cells.items():
            texts = (with_interval(*interval(each), leaks_in(each)) for each in found.values())
            rows.append([source, *(text.replace(" LEAK", "\nLEAK") for text in texts)])
        for source, found in others:
            gaps = (paired_difference(ours[fraction], found[fraction])[:3] for fraction in ours)
            whole = " [{:+.1f}, {:+.1f}]" if num_groups_of(next(iter(ours.values()))[0]) >= MIN_GROUPS else ""
            texts = (f"{100 * mean:+.1f}" + whole.format(100 * low, 100 * high) for mean, low, high in gaps)
            rows.append([f"gain over {source}", *texts])
        print(text_table(f"{result['data']}: {task}", columns, rows), file=file)
    _print_notes(result, result["records"], file)


def text_table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]], words: int = 1) -> str:
    """A table for the terminal, its first columns ``words`` and the others numbers."""
    align = ["left"] * words + ["right"] * (len(columns) - words)
    table = tabulate(rows, columns, "simple", disable_numparse=True, colalign=align if rows else None)
    return f"{title}\n{table}\n"
