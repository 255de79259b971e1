"""The board: one static page that compares results of one suite. Tasks down, encoders across, controls first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from html import escape
from pathlib import Path
from typing import Any

from mvitac.bench.charts import against_labels, against_parameters
from mvitac.bench.result import problems, read_result, records_of, suite_of
from mvitac.evaluation.leaks import UNKNOWN
from mvitac.evaluation.score_text import cell_text, percent, score_name, tested_on
from mvitac.evaluation.scores import by_cell, paired_difference, summarise
from mvitac.report import html as page
from mvitac.report.figures import to_svg
from mvitac.report.tables import probe_name
from mvitac.system.files import write_atomic

LAST = ("majority", "mean", "border", "pixels", "untrained")
"""Controls on the page, from left to right; the data's own columns come after majority and mean."""


@dataclass(frozen=True)
class Row:
    """A task by one modality: the records of every encoder and control, by name, and their summary."""

    task: str
    modality: str
    records: dict[str, list[dict[str, Any]]]
    cells: dict[str, dict[str, Any]]
    summary: dict[str, Any]

    @cached_property
    def score(self) -> str:
        return score_name({self.modality: self.cells})


@dataclass(frozen=True)
class Board:
    """The results of one suite.

    Attributes:
        results: As read, by the encoder's name.
        rows: Task by task and modality by modality.
        few: (task, modality) -> name -> [(share of labels, summary's cell)].
        not_run: One line for each task that a result lacks.
    """

    results: dict[str, dict[str, Any]]
    rows: list[Row]
    few: dict[tuple[str, str], dict[str, list[tuple[float, dict[str, Any]]]]]
    not_run: list[str]

    @property
    def controls(self) -> list[str]:
        found = dict.fromkeys(name for row in self.rows for name in row.cells if name not in self.results)
        return sorted(found, key=lambda name: LAST.index(name) if name in LAST else 1.5)

    @cached_property
    def encoders(self) -> list[str]:
        """Names of encoders by their mean rank over the rows that all of them have, the best one first."""
        common = [row for row in self.rows if all(name in row.cells for name in self.results)]
        ranks = {name: 0 for name in self.results}
        for row in common:
            for rank, name in enumerate(sorted(self.results, key=lambda n: -row.cells[n]["mean"])):
                ranks[name] += rank
        return sorted(self.results, key=lambda name: ranks[name])


def write_board(files: Sequence[Path], out: Path) -> Path:
    """Write the page that compares the results in ``files``.

    Raises:
        ValueError: If a file is no result, was changed, is of another suite or version than the others or than the one
            of this mvitac, has scores that its own sums do not give, or two results have one name.
    """
    results: dict[str, dict[str, Any]] = {}
    for path in files:
        result = read_result(path)
        if found := problems(result):
            raise ValueError(f"{path}: {found[0]}")
        first = next(iter(results.values()), result)
        if first["suite_digest"] != result["suite_digest"]:
            versions = " and ".join(f"{r['suite']['name']} ({r['suite_digest'][:12]})" for r in (first, result))
            raise ValueError(f"{path} is of another suite than {files[0]}: {versions}; make a board for each")
        if (name := result["encoder"]["name"]) in results:
            raise ValueError(f"{path}: another result is of an encoder named {name!r}: bench one of them with --name")
        results[name] = result
    text = _page(gather(results))
    write_atomic(out, lambda file: file.write(text.encode()))
    return out


def gather(results: dict[str, dict[str, Any]]) -> Board:
    """Put the blocks of all results side by side. Only those on the same rows are one row of the page."""
    suite = suite_of(next(iter(results.values())))
    rows: list[Row] = []
    few: dict[tuple[str, str], dict[str, list[tuple[float, dict[str, Any]]]]] = {}
    not_run: list[str] = []
    for number, (one, ask) in enumerate((one, ask) for one in suite.sets for ask in one.tasks):
        forms: dict[tuple[str, str], list[tuple[str, dict[str, Any]]]] = {}
        for name, result in results.items():
            block = result["blocks"][number]
            if "not_run" in block:
                not_run.append(f"{one.name}, {ask.name}: {name} was not run: {block['not_run']}")
            else:
                forms.setdefault((block["form"], block["data"]["rows"]), []).append((name, block))
        for (form, _), found in forms.items():
            records = [r for i, (name, block) in enumerate(found) for r in _mine(block, results[name]["encoder"], i)]
            task = f"{one.name}: {ask.name}{f' ({form})' if len(one.forms) > 1 else ''}"
            about = f"{task} ({tested_on(summarise(records, suite.probes[0])[ask.name], found[0][1]['group_by'])})"
            rows += _rows(about, records, suite.probes[0])
            for (_, modality, name), shares in _shares(records, suite.probes[0]).items():
                if len(shares) > 1:
                    few.setdefault((task, modality), {})[name] = shares
    return Board(results, rows, few, not_run)


def _mine(block: dict[str, Any], encoder: dict[str, Any], number: int) -> list[dict[str, Any]]:
    """The records of a block; of controls, which are the same for every encoder, those of the first result."""
    return [r for r in records_of(block, encoder) if r["source"] == encoder["name"] or not number]


def _rows(task: str, records: list[dict[str, Any]], probe: str) -> list[Row]:
    summary, cells = summarise(records, probe), by_cell(records, probe)
    rows = []
    for name, found in summary.items():
        none = found.get("none", {})
        for modality in (m for m in ("touch", "vision", "both") if m in found):
            own = {
                source: cells[name, modality if source in found[modality] else "none", source]
                for source in {**none, **found[modality]}
            }
            rows.append(Row(task, modality, own, {**none, **found[modality]}, found))
    return rows


def _shares(
    records: list[dict[str, Any]], probe: str
) -> dict[tuple[str, str, str], list[tuple[float, dict[str, Any]]]]:
    """(task, modality, name) -> (fraction of the labels, cell), from few labels to all."""
    kinds = {r["probe"]: float(r["probe"].split()[0]) / 100 for r in records if r["probe"].endswith("% of labels")}
    found: dict[tuple[str, str, str], list[tuple[float, dict[str, Any]]]] = {}
    for kind, share in sorted([*kinds.items(), (probe, 1.0)], key=lambda item: item[1]):
        mine = [r for r in records if r["probe"] == kind and r["modality"] != "none"]
        for task, modalities in summarise(mine, kind).items():
            for modality, cells in modalities.items():
                for name, cell in cells.items():
                    found.setdefault((task, modality, name), []).append((share, cell))
    return found


def order_of(row: Row, names: Sequence[str]) -> str:
    """Encoders from best to worst: '>' where the paired 95 % interval of a step excludes 0, '≈' where it does not.

    Encoders that saw test rows are not in the order.
    """
    clean = [name for name in names if name in row.cells and row.cells[name].get("leak", "") in ("", UNKNOWN)]
    found = sorted(clean, key=lambda name: -row.cells[name]["mean"])
    text = ""
    for ours, theirs in zip(found, found[1:], strict=False):
        mean, low, high, _ = paired_difference(row.records[ours], row.records[theirs])
        sign = ">" if low > 0 else "≈"
        text += f"{ours} {percent(row.cells[ours]['mean'])} {sign} ({percent(mean)} [{percent(low)}, {percent(high)}]) "
    left_out = [name for name in names if name in row.cells and name not in clean]
    text += f"{found[-1]} {percent(row.cells[found[-1]]['mean'])}" if found else "no encoder without a leak"
    return text + (f"; not ordered because of LEAK: {', '.join(left_out)}" if left_out else "")


def _page(board: Board) -> str:
    suite = suite_of(next(iter(board.results.values())))
    names = [probe_name(suite.probes[0], score) for score in dict.fromkeys(row.score for row in board.rows)]
    chips = {
        "suite": suite.name,
        "definition": suite.digest()[:12],
        "encoders": str(len(board.results)),
        "probe": " or ".join(names),
    }
    head = (
        f"<p class='eyebrow'>mvitac bench</p><h1>{escape(suite.name)}</h1><p class='verdict'>{escape(suite.title)}</p>"
        f"<ul class='chips'>{''.join(f'<li>{escape(k)} <b>{escape(v)}</b></li>' for k, v in chips.items())}</ul>"
    )
    sections = [
        ("scores", "Scores", _scores(board)),
        ("order", "Order", _orders(board)),
        ("encoders", "Encoders and leaks", _encoders(board)),
        ("parameters", "Score against parameters", _charts(board, labels=False)),
        ("labels", "Score against labels", _charts(board, labels=True)),
        ("data", "Data", _data(board)),
    ]
    foot = "<p>Made by mvitac bench board from signed results. A result's digest shows changes; it does not prove who made it.</p>"
    return page.html_page(f"mvitac bench: {suite.name}", head, [s for s in sections if s[2]], foot)


def _scores(board: Board) -> str:
    intro = (
        "Mean and 95 % interval over test groups (and seeds, where an encoder has several), in percent: accuracy, or R2 of"
        " values. Controls come first; encoders follow by their mean rank, which is for reading only: the order of each"
        " task is below. An empty cell was not run."
    )
    columns, rows, above = [*board.controls, *board.encoders], [], ""
    errors: list[list[str]] = []
    for row in board.rows:
        if row.task != above:
            rows.append([above := row.task])
        label = f"{row.modality}{', R2' if row.score == 'R2' else ''}"
        rows.append([label, *(cell_text(row.summary, name, row.modality) for name in columns)])
        for t, target in enumerate(next(iter(row.cells.values())).get("targets", ())):
            shown = [row.cells[name]["targets"][t] if name in row.cells else None for name in columns]
            what = f"{row.task.partition(' (')[0]}, {row.modality}, {target['name']} ({target['unit']})"
            errors.append([what, *("" if each is None else f"{each['mae']:.3g}" for each in shown)])
    found = page.table(["", *columns], rows, label="scores")
    if errors:
        found += page.fold("Mean absolute errors in their units", page.table(["", *columns], errors, label="errors"))
    return page.paragraph(intro) + found


def _orders(board: Board) -> str:
    intro = (
        "'>' means that the 95 % interval of the difference to the next encoder, paired over the test groups, excludes 0; '≈'"
        " means that this order is not resolved. Differences are in points, not corrected for the number of comparisons."
    )
    if len(board.results) < 2:
        return ""
    rows = [[f"{row.task.partition(' (')[0]}, {row.modality}", order_of(row, board.encoders)] for row in board.rows]
    return page.paragraph(intro) + page.table(["", "from best to worst"], rows, words=True, label="order")


def _encoders(board: Board) -> str:
    intro = (
        "Leaks compare the rows and groups that an encoder was trained on with the test rows, where a list of them came with"
        " the encoder. LEAK? stands where there is none and its owner's list of training data is not given either."
    )
    columns = [
        "",
        "leak",
        "parameters",
        "images seen",
        "licence",
        "trained on",
        "seeds",
        "input",
        "weights",
        "versions",
    ]
    rows = []
    for name in board.encoders:
        encoder, leaks = board.results[name]["encoder"], _leaks(board.results[name])
        sizes = ", ".join(f"{m} {num / 1e6:.1f} M" for m, num in encoder["parameters"].items())
        seen = f"{encoder['images_seen']:,}" if encoder["images_seen"] else "not known"
        versions = ", ".join(f"{k} {v}" for k, v in board.results[name]["versions"].items() if k in ("mvitac", "torch"))
        known = [
            encoder["licence"] or "not given",
            encoder["trained_on"] or "not given",
            ", ".join(map(str, encoder["seeds"])),
        ]
        weights = ", ".join(one[:12] for one in encoder["weights"])
        rows.append([name, leaks, sizes, seen, *known, f"{encoder['size']} px", weights, versions])
    return page.paragraph(intro) + page.table(columns, rows, words=True, label="encoders")


def _leaks(result: dict[str, Any]) -> str:
    """The leak column: LEAK with the tasks, LEAK? or "none found"."""
    marks: dict[str, list[str]] = {}
    for block in result["blocks"]:
        for leak in dict.fromkeys(block.get("leaks", ())):
            marks.setdefault(leak, []).append(f"{block['set']}, {block['task']}")
    found = [f"LEAK: {leak}: {'; '.join(tasks)}" for leak, tasks in marks.items() if leak not in ("", UNKNOWN)]
    return ". ".join([*found, *(["LEAK? not known"] if UNKNOWN in marks else [])]) or "none found"


def _charts(board: Board, labels: bool) -> str:
    drawn = []
    for row in board.rows if not labels else ():
        sizes = {n: r["encoder"]["parameters"] for n, r in board.results.items() if n in row.cells}
        if row.modality != "touch" or len(sizes) < 2:
            continue
        points = {name: (each["touch"], row.cells[name]) for name, each in sizes.items()}
        level = row.cells.get("untrained", {}).get("mean")
        title = row.task.partition(" (")[0]
        drawn.append((title, against_parameters(title, points, level, f"{row.score} %, touch")))
    for (task, modality), lines in board.few.items() if labels else ():
        title = f"{task}, {modality}"
        drawn.append(
            (title, against_labels(title, {n: lines[n] for n in (*board.encoders, *board.controls) if n in lines}))
        )
    figures = [
        page.figure(to_svg(figure, f"{labels} {title}", f"{title}: the numbers are in the results"))
        for title, figure in drawn
    ]
    return page.grid(figures) if figures else ""


def _data(board: Board) -> str:
    rows: dict[tuple[str, str, str], list[str]] = {}
    for name, result in board.results.items():
        for block in result["blocks"]:
            if "not_run" not in block:
                rows.setdefault((block["set"], block["form"], block["data"]["rows"][:12]), [])
                mine = rows[block["set"], block["form"], block["data"]["rows"][:12]]
                mine.append(f"{name} ({block['pinned']})") if f"{name} ({block['pinned']})" not in mine else None
    intro = (
        "Rows with another digest are never compared. 'same': also the images are those that the suite was measured on."
        " 'other pixels': made or decoded on another machine. 'not pinned': the suite has no digest of this form."
    )
    table = page.table(
        ["", "form", "digest of rows", "results"], [[*key, ", ".join(who)] for key, who in rows.items()], words=True
    )
    lost = (
        page.fold(f"{len(board.not_run)} tasks that were not run", page.code("\n".join(board.not_run)))
        if board.not_run
        else ""
    )
    return page.paragraph(intro) + table + lost
