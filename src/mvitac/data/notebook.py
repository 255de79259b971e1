"""How packs and models show themselves in a notebook: small HTML tables, a pack with a few of its pairs."""

import base64
import io
from collections.abc import Iterable, Sequence
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from mvitac.data.pack import Pack

NUM_PAIRS = 6


def table(rows: Iterable[Sequence[Any]], head: Sequence[str] = ()) -> str:
    """An HTML table; cells are escaped."""
    lines = ["".join(f"<th>{escape(str(cell))}</th>" for cell in head)] if head else []
    lines += ["".join(f"<td>{escape(str(cell))}</td>" for cell in row) for row in rows]
    return "<table>" + "".join(f"<tr>{line}</tr>" for line in lines) + "</table>"


def pack_html(pack: "Pack") -> str:
    """Rows, groups, labels and values of every split, and a few pairs from all over the pack."""
    rows, tasks = [], pack.spec.tasks
    for split in dict.fromkeys(pack.column("split").tolist()):
        chosen = pack.rows(split)
        labelled = [int((pack.labels(task.name)[chosen] >= 0).sum()) for task in tasks]
        ranges = [f"{v['low']:.3g} to {v['high']:.3g}" if v["rows"] else "" for v in measured(pack, chosen)]
        rows.append((split, len(chosen), len(np.unique(pack.column("group")[chosen])), *labelled, *ranges))
    head = ["split", "rows", "groups", *(f"{task.name} ({len(task.classes)} classes), labelled" for task in tasks)]
    head += [f"{target.name}, {target.unit}" for task in pack.spec.values for target in task.targets]
    shown = np.unique(np.linspace(0, pack.num - 1, min(NUM_PAIRS, pack.num)).astype(int))
    pictures = "<br>".join(_strip(pack, modality, shown) for modality in pack.spec.modalities)
    return f"<p>{escape(repr(pack))}</p>{table(rows, head)}{pictures}"


def measured(pack: "Pack", rows: np.ndarray) -> list[dict[str, Any]]:
    """Each target with its task, its unit, the number of ``rows`` with a value, and the lowest and highest one."""
    found = []
    for task in pack.spec.values:
        for target, values in zip(task.targets, pack.values(task)[rows].T, strict=True):
            have = values[np.isfinite(values)]
            ends = {"low": float(have.min()), "high": float(have.max())} if len(have) else {"low": None, "high": None}
            found.append({"task": task.name, "target": target.name, "unit": target.unit, "rows": len(have), **ends})
    return found


def _strip(pack: "Pack", modality: str, rows: np.ndarray) -> str:
    """Images of ``rows`` side by side, as one inline PNG; of two touch sensors the left one."""
    from PIL import Image

    file = io.BytesIO()
    rgb = [pack.images[modality][int(row)][..., :3] for row in rows]
    Image.fromarray(np.concatenate(rgb, axis=1)).save(file, "PNG")
    return f'<img alt="{modality}" src="data:image/png;base64,{base64.b64encode(file.getvalue()).decode()}">'
