"""Write the figures of benchmarks/gpu.sh into docs/speed.md.

    python -m benchmarks.gpu_tables [runs/gpu/gpu.json]

Each table stands between ``<!-- gpu: NAME -->`` and ``<!-- end -->``. Cells without a figure stay empty. The JSON is copied
to benchmarks/results/gpu.json, which is read if no file is given.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

from benchmarks.gpu import Size, plan
from mvitac.system.files import read_json, write_json

ROOT = Path(__file__).resolve().parents[1]
KEPT = ROOT / "benchmarks" / "results" / "gpu.json"
PAGES = {
    ROOT / "docs" / "speed.md": ("made", "step", "input", "memory", "rows"),
}
STEPS = {
    "typical fp32": "typical, fp32",
    "floor bf16": "floor, bf16",
    "ours fp32": "`mvitac`, fp32",
    "ours bf16": "`mvitac`, bf16",
    "ours bf16 compiled": "the same, compiled",
    "ours bf16 compiled, CUDA graphs": "the same, compiled, CUDA graphs",
    "ours bf16, cuDNN tuned": "the same, cuDNN's tuning",
}
"""Name of a variant in ``benchmarks.speed`` -> its name in the table."""
CONTROLS = ("untrained", "pixels", "border", "majority")


def number(value: float | None, digits: int = 3) -> str:
    """Return ``value`` with ``digits`` significant digits, or '' for None."""
    if value is None:
        return ""
    return f"{value:,.0f}" if abs(value) >= 10 ** (digits - 1) else f"{value:.{digits}g}"


def table(heads: Sequence[str], rows: Sequence[Sequence[str]], words: int) -> str:
    """Return a Markdown table. The first ``words`` columns are text."""
    rule = "|---" * words + "|---:" * (len(heads) - words) + "|"
    lines = [f"| {' | '.join(row)} |" for row in rows]
    return "\n".join([f"| {' | '.join(heads)} |", rule, *lines])


def step_table(found: dict[str, Any]) -> str:
    rows = []
    for call, batch in (("64", "64"), ("256", "256"), ("1024", "1024"), ("Lite0, 256", "256")):
        plain, tried = section(found, call, batch, "step"), section(found, f"{call} compiled", batch, "compiled")
        for name, shown in STEPS.items():
            row = plain.get("variants", {}).get(name) or tried.get("variants", {}).get(name, {})
            lost = name in {**plain.get("lost", {}), **tried.get("lost", {})}
            figures = [number(row.get(key)) for key in ("pairs_per_s", "of_floor", "of_matmul_peak", "over_typical")]
            rows.append(
                [call, shown, "not possible" if lost else figures[0], *figures[1:], number(row.get("peak_gib"))]
            )
    heads = ["batch", "step", "pairs/s", "share of floor", "share of matrix-product peak", "times typical", "peak GiB"]
    return table(heads, rows, 2)


def section(found: dict[str, Any], name: str, batch: str, part: str) -> dict[str, Any]:
    """Return one section of a call of ``benchmarks.speed``; {} if it was not measured."""
    return found.get("speed", {}).get(name, {}).get(f"batch {batch}", {}).get(part, {})


def input_table(found: dict[str, Any]) -> str:
    images, whole = section(found, "256", "256", "input"), section(found, "256", "256", "whole")
    variants = whole.get("variants", {})
    heads = ["batch 256", "typical", "`mvitac`, bf16", "times typical"]

    def line(title: str, rows: dict[str, Any], key: str, old: str, new: str) -> list[str]:
        values = [rows.get(old, {}).get(key), rows.get(new, {}).get(key), rows.get(new, {}).get("over_typical")]
        return [title, *map(number, values)]

    end, step = "ours bf16, pack to weights", "ours bf16, step alone"
    rows = [
        line("input, images/s", images, "images_per_s", "typical, JPEG files", "ours, pack, bf16"),
        line("end to end, pairs/s", variants, "pairs_per_s", "typical, JPEG files to weights", end),
        ["end to end, share of the step alone", "", number(variants.get(end, {}).get("of_step_alone")), ""],
        ["the step alone, pairs/s", "", number(variants.get(step, {}).get("pairs_per_s")), ""],
        ["the paper's pre-training, hours", "", number(whole.get("hours_for_the_papers_pretraining")), ""],
    ]
    return table(heads, rows, 1)


def memory_table(found: dict[str, Any]) -> str:
    known = found.get("speed", {}).get("caching", {}).get("caching", {})
    names = {"plain 256": "256, plain", "4096 in chunks of 256": "4,096 in chunks of 256"}
    rows = [
        [shown, number(known.get(name, {}).get("peak_gib")), number(known.get(name, {}).get("ms_per_pair"))]
        for name, shown in names.items()
    ]
    return table(["batch", "GiB", "ms per pair"], rows, 1)


def rows_table(found: dict[str, Any]) -> str:
    scored = found.get("table", {})
    cells = {(c["row"], c["task"], c["modality"]): c for c in scored.get("cells", ())}
    cost = {c["row"]: c for c in scored.get("cost", ())}
    wanted = [(task, modality) for task in ("category", "soft", "rough") for modality in ("touch", "vision", "both")]
    rows = []
    for row in [*(row["label"] for row in plan(Size())["rows"]), *CONTROLS]:
        values = []
        for task, modality in wanted:
            cell = cells.get((row, task, modality)) or cells.get((row, task, "none"))
            values.append(
                f"{100 * cell['mean']:.1f} [{100 * cell['low']:.1f}, {100 * cell['high']:.1f}]" if cell else ""
            )
        for direction in ("vision -> touch", "touch -> vision"):
            mine = [r["R@5"] for r in scored.get("retrieval", ()) if (r["source"], r["direction"]) == (row, direction)]
            values.append(f"{100 * fmean(mine):.1f}" if mine else "")
        known = cost.get(row, {})
        shown = f"*{row}*" if row in CONTROLS else row
        rows.append([shown, str(known.get("seeds", "")), *values, number(known.get("seconds"))])
    heads = [
        "",
        "seeds",
        *(f"{task}: {modality}" for task, modality in wanted),
        "R@5 v to t",
        "t to v",
        "seconds a run",
    ]
    return table(heads, rows, 1)


def made(found: dict[str, Any]) -> str:
    """Return what was measured where, in a sentence."""
    last, data = found["sessions"][-1], found["data"]
    device = next((part["device"] for part in found["speed"].values() if "device" in part), "unknown device")
    minutes = sum(call["minutes"] for call in found["sessions"])
    return (
        f"{device}, torch {last['versions']['torch']}, commit {(last['commit'] or 'unknown')[:7]}, {last['date'][:10]},"
        f" {len(found['sessions'])} calls of {minutes:g} minutes in all, {data['num']} pairs simulated in"
        f" {data['seconds']:.0f} s on {data['cores']} cores."
    )


TABLES = {"step": step_table, "input": input_table, "memory": memory_table, "rows": rows_table, "made": made}


def filled(text: str, names: Sequence[str], found: dict[str, Any]) -> str:
    """Return a page with its tables made from ``found``; ValueError if it has no place for one."""
    for name in names:
        place = re.compile(rf"(<!-- gpu: {name} -->\n).*?(\n<!-- end -->)", re.DOTALL)
        if not place.search(text):
            raise ValueError(f"the page has no <!-- gpu: {name} --> ... <!-- end -->")
        made = TABLES[name](found) if found else "Not measured yet."
        text = place.sub(lambda match, made=made: match[1] + made + match[2], text)
    return text


def main() -> None:
    source = Path(sys.argv[1]) if len(sys.argv) > 1 else KEPT
    found = read_json(source, "figures of benchmarks/gpu.sh")
    if found["size"]["trunk"] != Size().trunk:
        raise SystemExit(f"{source} is of a rehearsal: its figures have no meaning")
    if source != KEPT:
        write_json(KEPT, found)
    for page, names in PAGES.items():
        page.write_text(filled(page.read_text(), names, found))
        print(f"written: {page}")


if __name__ == "__main__":
    main()
