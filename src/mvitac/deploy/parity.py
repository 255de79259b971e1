"""Whether an export is the trained model: its outputs on test rows next to those of the code that was scored."""

import timeit
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from mvitac.data.pack import Pack
from mvitac.deploy.engine import Call, cosines
from mvitac.deploy.export_module import ExportModule, output_of
from mvitac.model import Model


def reference(
    model: Model, graph: ExportModule, pack: Pack, rows: np.ndarray, advance: Callable[[int], object] = lambda num: None
) -> dict[str, np.ndarray]:
    """The outputs of ``graph`` for pack rows, computed by the code of ``Model`` itself."""
    chunks = []
    for chunk in np.array_split(rows, max(1, len(rows) // 64)):
        images = {m: pack.images[m][chunk] for m in graph.modalities}
        shown = {m: graph.looks(x) if graph.looks and m == "touch" else [x] for m, x in images.items()}
        looks = {m: [torch.from_numpy(x).permute(0, 3, 1, 2) for x in each] for m, each in shown.items()}
        features = {m: torch.stack([model.features(m, x) for x in each]).mean(0) for m, each in looks.items()}
        found = {f"embedding_{m}": x for m, x in features.items()}
        for m in graph.projectors:
            wide = torch.stack([model.features(m, x, for_heads=True) for x in looks[m]]).mean(0)
            found[f"shared_{m}"] = model.project(m, wide)
        joined = torch.cat([features[m] for m in ("vision", "touch") if m in features], dim=1)
        found |= {output_of(r): r(joined) for r in graph.probes}  # type: ignore[arg-type]
        chunks.append(found)
        advance(len(chunk))
    return {name: torch.cat([c[name] for c in chunks]).numpy() for name in graph.outputs}


def parity(
    graph: ExportModule,
    call: Call,
    pack: Pack,
    rows: np.ndarray,
    wanted: dict[str, np.ndarray],
    *,
    min_cosine: float,
    accuracy_loss: float = 0.5,
    value_loss: float = 0.1,
    advance: Callable[[int], object] = lambda num: None,
) -> dict[str, Any]:
    """Compare the outputs of ``call`` for pack rows with those ``wanted``. The limits are those of ``ExportConfig``.

    Returns num_rows; cosine by embedding (min, mean); accuracy by task (original, export, num labelled rows); errors of
    values by task. ValueError if they differ by more than a limit allows.
    """
    chunks = []
    for chunk in np.array_split(rows, max(1, len(rows) // 16)):  # batches of another size than the traced one
        chunks.append(call([np.ascontiguousarray(pack.images[m][chunk]) for m in graph.modalities]))
        advance(len(chunk))
    found = {name: np.concatenate([c[i] for c in chunks]) for i, name in enumerate(graph.outputs)}
    report: dict[str, Any] = {"num_rows": len(rows), "cosine": {}, "accuracy": {}, "values": {}}
    for name in (n for n in graph.outputs if n.startswith(("embedding_", "shared_"))):
        values = cosines(found[name], wanted[name])
        report["cosine"][name] = {"min": float(values.min()), "mean": float(values.mean())}
        if not values.min() >= min_cosine:
            how = f"{name} has cosine {values.min():.4f} on real inputs, at least {min_cosine} is allowed (min_cosine)"
            raise ValueError(f"the export is not the trained model: {how}")
    for task, known in graph.classes.items():
        labels, name = labels_of(pack, task, known, rows), f"probability_{task}"
        if not (labels >= 0).any():
            continue
        right = [(x[name].argmax(1) == labels)[labels >= 0] for x in (wanted, found)]
        before, after = (100 * float(x.mean()) for x in right)
        if not before - after <= accuracy_loss:
            how = f"accuracy on {task} from {before:.1f} to {after:.1f} % of {len(right[0])} rows"
            raise ValueError(f"the export lowers {how}, at most {accuracy_loss} points are allowed (--accuracy-loss)")
        report["accuracy"][task] = {"original": before, "export": after, "num": len(right[0])}
    for task, targets in graph.values.items():
        columns = zip(targets, wanted[f"value_{task}"].T, found[f"value_{task}"].T, strict=True)
        report["values"][task] = [_error(pack, rows, *column, value_loss) for column in columns]
    return report


def _error(
    pack: Pack, rows: np.ndarray, target: dict[str, Any], wanted: np.ndarray, found: np.ndarray, limit: float
) -> dict[str, Any]:
    """What an export does to one target, in its unit; ValueError if values change by more than ``limit`` deviations.

    The deviation is that of the measured values, or of the model's own where fewer than two were measured in this unit.
    """
    name, unit, true = target["name"], target["unit"], np.full(len(rows), np.nan)
    for task in pack.spec.values:
        for t, known in enumerate(task.targets):
            if (known.name, known.unit) == (name, unit):
                true = pack.values(task)[rows, t]
    have = ~np.isnan(true)
    std = float((true[have] if have.sum() > 1 else wanted).std())
    change, allowed = float(((found - wanted) ** 2).mean() ** 0.5), limit * std
    if not change <= allowed:
        how = f"by {change:.3g} {unit} (root mean square), at most {allowed:.3g} is allowed (--value-loss)"
        raise ValueError(f"the export changes {name} {how}")
    before, after = (float(abs(x - true)[have].mean()) if have.any() else None for x in (wanted, found))
    errors = {"original": before, "export": after, "num": int(have.sum()), "change": change, "allowed": allowed}
    return {"name": name, "unit": unit, **errors}


def labels_of(pack: Pack, task: str, classes: list[str], rows: np.ndarray) -> np.ndarray:
    """Labels [len(rows)] of pack rows as indices into ``classes``, matched by name; -1 = unlabelled or unknown class."""
    own = next((t.classes for t in pack.spec.tasks if t.name == task), None)
    if own is None:
        return np.full(len(rows), -1)
    numbers = np.array([*(classes.index(name) if name in classes else -1 for name in own), -1])
    return numbers[pack.column(f"label_{task}")[rows].astype(int)]


def latency(call: Call, one: list[np.ndarray], *, num: int = 100, warm: int = 10) -> dict[str, float]:
    """p50 and p99 in ms of ``num`` calls with a batch of one pair, after ``warm`` calls that are not measured."""
    times = timeit.repeat(lambda: call(one), number=1, repeat=warm + num)[warm:]
    p50, p99 = 1000 * np.percentile(times, [50, 99])
    return {"p50": round(float(p50), 3), "p99": round(float(p99), 3)}
