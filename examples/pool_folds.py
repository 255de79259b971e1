"""Pool the probes of cross-validation folds (disjoint test groups) into one table, as Markdown.

    python examples/pool_folds.py runs/real/slip_grasp/fold*.json > runs/real/slip_grasp.md

Every test group of every fold then counts once per seed; intervals are over all groups. AUROC, which cannot be pooled
over folds fitted apart, is the mean of the folds'.
"""

import json
import sys
from collections import defaultdict
from pathlib import Path
from typing import Any

from mvitac.scores import summarise
from mvitac.tables import markdown

Record = dict[str, Any]


def pool(results: list[dict[str, Any]]) -> dict[str, Any]:
    """One result from those of several folds."""
    pooled: dict[tuple[Any, ...], Record] = {}
    for result in results:
        for record in result["records"]:
            key = tuple(record[name] for name in ("source", "seed", "task", "modality", "probe"))
            mine = pooled.setdefault(key, {**record, "group_sizes": [], "group_correct": []})
            mine["group_sizes"] = mine["group_sizes"] + record["group_sizes"]
            mine["group_correct"] = mine["group_correct"] + record["group_correct"]
    # Retrieval among less than ten things says nothing: any answer is a hit.
    retrieval = [r for result in results for r in result["retrieval"] if r["chance R@5"] < 0.5]
    records = list(pooled.values())
    return {**results[0], "records": records, "retrieval": retrieval, "summary": summarise(records)}


def auroc_table(results: list[dict[str, Any]]) -> str:
    """Mean AUROC over folds and seeds where a task has two classes; '' where none has."""
    found: dict[tuple[str, str], dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    for record in (r for result in results for r in result["records"]):
        if record["auroc"] is not None and record["probe"] == "linear" and record["source"] != "majority":
            found[record["task"], record["source"]][record["modality"]].append(record["auroc"])
    if not found:
        return ""
    columns = [m for m in ("none", "touch", "vision", "both") if any(m in row for row in found.values())]
    lines = [
        f"| AUROC | {' | '.join(c.replace('none', 'no image') for c in columns)} |",
        f"|---{'|---:' * len(columns)}|",
    ]
    for (_, source), row in found.items():
        cells = [
            f"{sum(row[c]) / len(row[c]):.2f} ({min(row[c]):.2f}-{max(row[c]):.2f})" if c in row else ""
            for c in columns
        ]
        lines.append(f"| {source} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(f"usage: python {sys.argv[0]} PROBE.JSON...")
    results = [json.loads(Path(name).read_text()) for name in sys.argv[1:]]
    num = len(pool(results)["records"][0]["group_sizes"])
    print(f"{results[0]['data']}: {num} test {results[0]['group_by']}s in {len(results)} fold(s)\n")
    print(markdown(pool(results)))
    print(auroc_table(results))
