"""``mvitac data info`` and ``mvitac data show``: what is in a pack, or in several as one."""

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from rich.table import Table
from tyro.conf import Positional

from mvitac.cli.options import check_json, console, parse, save_json, selectors, short
from mvitac.data.notebook import measured
from mvitac.data.pack import Pack
from mvitac.data.pack_table import SPLITS
from mvitac.data.spec import Task
from mvitac.datasets.base import DatasetConfig
from mvitac.registry import default
from mvitac.system.files import check_place, write_atomic

OWN_COLUMNS = ("id", "group", "touch_group", "split", "sensor")
"""Columns that packing adds to a table."""


def groups_text(pack: Pack) -> str:
    """What a group of the pack is and what that does to splits and intervals."""
    by, sizes = pack.spec.group_by, list(Counter(pack.column("group").tolist()).values())
    few, many = min(sizes), max(sizes)
    rows = f"{few} row{'s' * (few > 1)}" if few == many else f"{few} to {many} rows"
    text = (
        f"groups: {len(sizes)}, one per {by}, of {rows} each. A split takes whole groups, and intervals resample them"
    )
    if by != "row" or many > 1:
        return f"{text}."
    own = [*OWN_COLUMNS, *(task.name for task in pack.spec.tasks)]
    table = pack.table.drop_columns([name for name in own if name in pack.table.column_names])
    repeated = [name for name in table.column_names if 1 < len(table.column(name).unique()) <= pack.num / 2]
    repeated = [name for name in repeated if not name.startswith(("label_", "has_", "crc_", "bytes_"))]
    return (
        f"{text}.\nNo --group was given, so every row is a group of its own. If rows show the same object or recording,"
        " train and test then share it: scores are too high and intervals too narrow. In that case pack again with"
        f" --group COLUMN{f' (this table has {_some(repeated)})' if repeated else ''}."
    )


def _some(names: list[str]) -> str:
    return ", ".join(names[:6]) + ", ..." * (len(names) > 6)


@dataclass(frozen=True, kw_only=True)
class _InfoOptions:
    json: Path | None = None
    """Also write what is printed to this file; - = stdout, and the table to stderr."""


@dataclass(frozen=True, kw_only=True)
class _PackInfoOptions(_InfoOptions):
    """The splits of a pack: rows, groups and the most frequent class of each task.

    Of several packs as one: mvitac data info --data mix --parts a=packs/a b=packs/b
    """

    pack: Positional[Path]
    """Folder of the pack."""


@dataclass(frozen=True, kw_only=True)
class _DataInfoOptions(_InfoOptions):
    """The splits of data: rows, groups and the most frequent class of each task."""

    data: Annotated[DatasetConfig, tyro.conf.arg(name="")]


def _parse_opened(kind: Any, of_data: Any, argv: list[str], prog: str) -> Any:
    """Options of a command on PACK (``kind``) or on --data pack, stream or mix (``of_data``)."""
    chosen, rest = selectors(argv, ("--data",))
    if "--data" not in chosen:
        return parse(kind, rest, prog)
    config = default(DatasetConfig, chosen["--data"])
    if not config.is_pack:
        raise ValueError(f"--data {config.name} is not packed yet: pack it (mvitac data pack), and give the folder")
    return parse(of_data, short(rest), f"{prog} --data {config.name}", default=of_data(data=config))


def info(argv: list[str]) -> None:
    """mvitac data info PACK | --data mix --parts A B [--json FILE]"""
    options = _parse_opened(_PackInfoOptions, _DataInfoOptions, argv, "data info")
    check_json(options.json)
    pack = Pack(options.pack) if isinstance(options, _PackInfoOptions) else options.data.open()
    found, say = _describe(pack), console(options.json)
    stored = "" if pack.store == "raw" or pack.parts else f", JPEG of quality {pack.meta['quality']}"
    title = f"{pack.path}: {pack.spec.name}, {pack.num} samples at {pack.size} px{stored}"
    table = Table(title=title, title_justify="left")
    groups = "groups" if pack.spec.group_by == "row" else f"{pack.spec.group_by}s"
    values = [f"{v['target']}, {v['unit']}" for v in next(iter(found["splits"].values()), {}).get("values", ())]
    for column in ("split", "rows", groups, *(f"{t.name}: majority" for t in pack.spec.tasks), *values):
        table.add_column(column)
    for name, split in found["splits"].items():
        cells = [f"{m['class']} {100 * m['share']:.1f} %" if m else "" for m in split["majority"].values()]
        cells += [f"{v['low']:.3g} to {v['high']:.3g}" if v["rows"] else "" for v in split.get("values", ())]
        table.add_row(name, str(split["rows"]), str(split["groups"]), *cells)
    say.print(table)
    if lacking := ", ".join(f"{num} rows without {m}" for m, num in found["rows_without"].items()):
        say.print(f"{lacking}; {found['whole_pairs']} whole pairs")
    say.print(groups_text(pack))
    say.print(f"source {pack.spec.source}; licence {pack.spec.licence}")
    for note in pack.spec.notes:
        say.print(f"note: {note}")
    save_json(options.json, found)


def _describe(pack: Pack) -> dict[str, Any]:
    """What ``info`` prints of a pack, JSON-ready."""
    splits = {}
    for split in SPLITS:
        if len(rows := pack.rows(split)):
            groups = len(set(pack.column("group")[rows]))
            majority = {task.name: _majority(pack, task, split) for task in pack.spec.tasks}
            splits[split] = {"rows": len(rows), "groups": groups, "majority": majority}
            if pack.spec.values:
                splits[split]["values"] = _values(pack, rows)
    has = {m: pack.has(m) for m in pack.spec.modalities}
    return {
        "path": str(pack.path),
        "name": pack.spec.name,
        "rows": pack.num,
        "size": pack.size,
        "store": pack.store,
        "group_by": pack.spec.group_by,
        "groups": len(np.unique(pack.column("group"))),
        "splits": splits,
        "rows_without": {m: int((~there).sum()) for m, there in has.items() if not there.all()},
        "whole_pairs": int(np.logical_and.reduce(list(has.values())).sum()),
        "source": pack.spec.source,
        "licence": pack.spec.licence,
        "notes": list(pack.spec.notes),
        "digest": pack.digest,
    }


def _values(pack: Pack, rows: np.ndarray) -> list[dict[str, Any]]:
    """Each target with its unit, the number of measured rows, and their lowest and highest value."""
    targets = [(task.name, target) for task in pack.spec.values for target in task.targets]
    return [
        {"task": task, "target": target.name, "unit": target.unit, "rows": num, "low": low, "high": high}
        if num
        else {"task": task, "target": target.name, "unit": target.unit, "rows": 0, "low": None, "high": None}
        for (task, target), (num, low, high) in zip(targets, measured(pack, rows), strict=True)
    ]


def _majority(pack: Pack, task: Task, split: str) -> dict[str, Any] | None:
    """The most frequent class of a task in ``split`` and its share of the labelled rows; None without labels."""
    labels = pack.column(f"label_{task.name}")[pack.rows(split, only=task.only, by=task.split)]
    labels = labels[labels >= 0]
    if not len(labels):
        return None
    common = int(np.bincount(labels).argmax())
    return {"class": task.classes[common], "share": float((labels == common).mean())}


@dataclass(frozen=True, kw_only=True)
class _ShowOptions:
    by: str = ""
    """Task or table column, one strip per value (default: the first task, else the group)."""
    split: str = ""
    """Show rows of train, val, test or unlabelled only."""
    num: int = 6
    """Pairs per strip, of different groups if there are enough."""
    limit: int = 40
    """Maximum number of strips."""
    side: int = 96
    """Height of a picture in pixels."""
    seed: int = 0
    """Seed of the draw."""
    out: Path | None = None
    """A .png or an .html (default: NAME-OF-THE-PACK.png here)."""


@dataclass(frozen=True, kw_only=True)
class _PackShowOptions(_ShowOptions):
    """A few pairs of every class or object, to check by eye.

    Of several packs as one: mvitac data show --data mix --parts a=packs/a b=packs/b --by part
    """

    pack: Positional[Path]
    """Folder of the pack."""


@dataclass(frozen=True, kw_only=True)
class _DataShowOptions(_ShowOptions):
    """A few pairs of every class or object, to check by eye."""

    data: Annotated[DatasetConfig, tyro.conf.arg(name="")]


def show(argv: list[str]) -> None:
    """mvitac data show PACK | --data mix --parts A B [--by TASK|COLUMN] [--out FILE.png|FILE.html]"""
    options = _parse_opened(_PackShowOptions, _DataShowOptions, argv, "data show")
    on_disk = isinstance(options, _PackShowOptions)
    out = options.out or Path(f"{options.pack.resolve().name if on_disk else options.data.name}.png")
    if out.suffix.lower() not in (".png", ".html"):
        raise ValueError(f"--out {out}: give a name that ends in .png or .html")
    if not 16 <= options.side <= 1024:
        raise ValueError(f"--side {options.side}: give 16 to 1024 pixels")
    if options.seed < 0:
        raise ValueError(f"--seed {options.seed}: give a number >= 0")
    from mvitac.report import contact_sheet

    check_place(out)
    pack = Pack(options.pack) if on_disk else options.data.open()
    found, num_all = contact_sheet.strips(
        pack, options.by, split=options.split, num=options.num, limit=options.limit, seed=options.seed
    )
    if out.suffix.lower() == ".html":
        text = contact_sheet.to_html(pack, found, num_all, side=options.side)
        write_atomic(out, lambda file: file.write(text.encode()))
    else:
        picture = contact_sheet.to_image(pack, found, num_all, side=options.side)
        write_atomic(out, lambda file: picture.save(file, "PNG"))
    print(f"{out}: {len(found)} of {num_all} strips")
