"""``mvitac data ...``: simulate and pack data, and look at what is in a pack."""

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from textwrap import fill
from typing import Annotated, Any

import numpy as np
import tyro
from tabulate import tabulate
from tyro.conf import Positional

from mvitac.cli.options import asks_help, check_json, parse, printed_to, save_json, selectors
from mvitac.data.build import build
from mvitac.data.pack import Pack
from mvitac.data.pack_table import SPLITS
from mvitac.data.row_hashes import split_leaks
from mvitac.data.spec import Task, Window, listed
from mvitac.datasets.base import DatasetConfig, dataset
from mvitac.datasets.mix import open_packs
from mvitac.system.files import check_place


@dataclass(frozen=True, kw_only=True)
class _BuildOptions:
    out: Path
    """Folder of the new pack."""
    data: Annotated[DatasetConfig, tyro.conf.arg(name="")]
    max_damaged: float = 0.0
    """Share of the items that may be unreadable before packing stops; they are listed in pack.json."""
    quiet: bool = False
    """No progress bar."""


def pack(argv: list[str]) -> None:
    chosen, rest = selectors(argv, ("--data",))
    if "--data" not in chosen:
        packed = (name for name, kind in DatasetConfig.choices.items() if kind.source is not DatasetConfig.source)
        usage = f"mvitac data pack --data {'|'.join(packed)} --out DIR"
        if asks_help(rest):
            print(f"usage: {usage}\n\nThe options of one: mvitac data pack --data NAME --help")
            return
        raise ValueError(f"name the dataset: {usage}")
    config: Any = dataset(chosen["--data"])
    usual = _BuildOptions(out=tyro.MISSING, data=config)
    prog = f"data pack --data {chosen['--data']}"
    options = parse(_BuildOptions, rest, prog, default=usual, description=type(config).__doc__ or "")
    check_place(options.out)
    data: Any = options.data
    if data.frame_window() != Window():
        raise ValueError("a pack stores every frame once: give --num-frames, ... to what reads the pack")
    given = {"max_damaged": options.max_damaged, "quiet": options.quiet, **data.build_options()}
    pack = build(data.source(), options.out, **given)
    print(f"{pack.path}: {pack.num} samples at {pack.size} px")
    if lost := pack.meta["damaged"]:
        print(f'{len(lost)} left out, listed under "damaged" in {pack.path / "pack.json"}; first {": ".join(lost[0])}')
    print(_groups(pack))
    for note in pack.spec.notes:
        print(fill(f"note: {note}", 80))


def _groups(pack: Pack) -> str:
    sizes = Counter(pack.column("group").tolist()).values()
    rows = " to ".join(map(str, dict.fromkeys((min(sizes), max(sizes)))))
    about = f"groups: {len(sizes)}, one per {pack.spec.group_by}, of {rows} row{'s' * (rows != '1')} each. "
    if max(sizes) > 1 and len(np.unique(pack.touch_groups)) == len(sizes):
        about += "Each is one touch group, too: its rows may be each other's positives. "
    leaks = "; ".join(split_leaks(pack, pack.spec.all_tasks).values())
    about += f"LEAK: {leaks}." if leaks else "A split takes whole groups, and intervals are over them."
    return fill(about, 80)


@dataclass(frozen=True)
class _InfoOptions:
    """The splits of a pack: rows, groups and the most frequent class of each task."""

    pack: Positional[tuple[str, ...]]
    """Folder of the pack. Several, each FOLDER or NAME=FOLDER, are taken as one (--data mix)."""
    json: Path | None = None
    """Also write what is printed to this file; - = stdout, and the table to stderr."""


def info(argv: list[str]) -> None:
    options = parse(_InfoOptions, argv, "data info")
    check_json(options.json)
    pack = open_packs(options.pack)
    found, say = _describe(pack), printed_to(options.json)
    stored = "" if pack.store == "raw" else f", JPEG of quality {pack.meta['quality']}"
    title = f"{pack.path}: {pack.spec.name}, {pack.num} samples at {pack.size} px{stored}"
    groups = "groups" if pack.spec.group_by == "row" else f"{pack.spec.group_by}s"
    values = [f"{v['target']}, {v['unit']}" for v in next(iter(found["splits"].values()), {}).get("values", ())]
    heads = ("split", "rows", groups, *(f"{t.name}: majority" for t in pack.spec.tasks), *values)
    rows = []
    for name, split in found["splits"].items():
        cells = [f"{m['class']} {100 * m['share']:.1f} %" if m else "" for m in split["majority"].values()]
        cells += [f"{v['low']:.3g} to {v['high']:.3g}" if v["rows"] else "" for v in split.get("values", ())]
        rows.append([name, split["rows"], split["groups"], *cells])
    print(title, tabulate(rows, heads), "", sep="\n", file=say)
    if lacking := ", ".join(f"{num} rows without {m}" for m, num in found["rows_without"].items()):
        print(f"{lacking}; {found['whole_pairs']} whole pairs", file=say)
    print(_groups(pack), file=say)
    if names := found.get("sensors"):
        print(f"touch sensors: {listed(names)}", file=say)
    print(f"source {pack.spec.source}; licence {pack.spec.licence}", file=say)
    for note in pack.spec.notes:
        print(f"note: {note}", file=say)
    save_json(options.json, found)


def _describe(pack: Pack) -> dict[str, Any]:
    splits = {}
    for split in SPLITS:
        if len(rows := pack.rows(split)):
            groups = len(set(pack.column("group")[rows]))
            majority = {task.name: _majority(pack, task, split) for task in pack.spec.tasks}
            splits[split] = {"rows": len(rows), "groups": groups, "majority": majority}
            if pack.spec.values:
                splits[split]["values"] = measured(pack, rows)
    has = {m: pack.has(m) for m in pack.spec.modalities}
    spec, groups = pack.spec, len(np.unique(pack.column("group")))
    about = {"path": str(pack.path), "name": spec.name, "rows": pack.num, "size": pack.size, "store": pack.store}
    about |= {"group_by": spec.group_by, "groups": groups, "splits": splits}
    about["rows_without"] = {m: int((~there).sum()) for m, there in has.items() if not there.all()}
    about |= {"sensors": list(pack.sensor_names)} if "sensor" in pack.table.column_names else {}
    about["whole_pairs"] = int(np.logical_and.reduce(list(has.values())).sum())
    return about | {"source": spec.source, "licence": spec.licence, "notes": list(spec.notes), "digest": pack.digest}


def measured(pack: Pack, rows: np.ndarray) -> list[dict[str, Any]]:
    """Each target with its task, its unit, the number of ``rows`` with a value, and the lowest and highest one."""
    found = []
    for task in pack.spec.values:
        for target, values in zip(task.targets, pack.values(task)[rows].T, strict=True):
            have = values[np.isfinite(values)]
            ends = {"low": float(have.min()), "high": float(have.max())} if len(have) else {"low": None, "high": None}
            found.append({"task": task.name, "target": target.name, "unit": target.unit, "rows": len(have), **ends})
    return found


def _majority(pack: Pack, task: Task, split: str) -> dict[str, Any] | None:
    """The most frequent class of a task in ``split`` and its share of the labelled rows; None without labels."""
    labels = pack.column(f"label_{task.name}")[pack.rows(split, only=task.only, by=task.split)]
    if not len(labels := labels[labels >= 0]):
        return None
    common = int(np.bincount(labels).argmax())
    return {"class": task.classes[common], "share": float((labels == common).mean())}
