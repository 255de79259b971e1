"""A contact sheet of a pack: a few pairs of each class or object, to check the data by eye.

Check that camera and touch belong together, labels are right, colours look natural, and nothing is blank or upside down.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image

from mvitac.data.checks.finding import Finding
from mvitac.data.pack import Pack
from mvitac.data.pack_table import SPLITS
from mvitac.registry import unknown
from mvitac.report.image_grid import Block, Tile, contents, draw, pair

TASK = "label_"
SIDE, NUM_SHOWN, NUM_SAMPLE = 96, 8, 24  # pixels; rows shown of a finding; rows shown if nothing is suspicious


@dataclass(frozen=True)
class Strip:
    """One class or object: name, number of rows and groups, and the rows to show."""

    name: str
    num_rows: int
    num_groups: int
    rows: np.ndarray


def strips(
    pack: Pack, by: str = "", *, split: str = "", num: int = 6, limit: int = 40, seed: int = 0
) -> tuple[list[Strip], int]:
    """Choose random rows of each value of the task or column ``by`` (default: the first task, else the group).

    Of its ``num`` rows, those of different groups (within one group: touches) come first. Returns at most ``limit``
    strips, and their number without it.
    """
    if split and split not in SPLITS:
        raise unknown("split", split, SPLITS)
    if num < 1 or limit < 1:
        raise ValueError(f"num {num}, limit {limit}: give at least 1")
    names = [task.name for task in pack.spec.tasks]
    by = by or (names[0] if names else "group")
    if by in names:
        task = pack.spec.tasks[names.index(by)]
        words = np.array([*task.classes, "(no label)"])[pack.column(f"{TASK}{by}")]
        order = [*task.classes, "(no label)"]
    elif by in pack.table.column_names:
        words = pack.column(by).astype(str)
        order = sorted(set(words))
    else:
        raise unknown("task or column", by, [*names, *pack.table.column_names])
    allowed = np.isin(pack.column("split"), (split,) if split else SPLITS)
    groups = np.unique(pack.column("group").astype(str), return_inverse=True)[1]
    rng = np.random.default_rng(seed)
    found = []
    for name in order:
        rows = np.flatnonzero((words == name) & allowed)
        if len(rows):
            several = len(set(groups[rows]))
            apart = groups[rows] if several > 1 else pack.touch_groups[rows]
            found.append(Strip(name, len(rows), several, _spread(rows, apart, num, rng)))
    if not found:
        raise ValueError(f"{pack.path} has no rows in split {split}: choose another")
    return found[:limit], len(found)


def _spread(rows: np.ndarray, groups: np.ndarray, num: int, rng: np.random.Generator) -> np.ndarray:
    """Draw ``num`` of ``rows``, one of every group before a second of any."""
    order = rng.permutation(len(rows))
    turns: dict[int, int] = {}
    keys = []
    for group in groups[order].tolist():
        keys.append(turns.get(group, 0))
        turns[group] = keys[-1] + 1
    return rows[order[np.argsort(keys, kind="stable")][:num]]


def heading(strip: Strip, pack: Pack) -> str:
    """Heading such as ``wood: 48 rows, 12 objects``."""
    groups = f", {strip.num_groups} {pack.spec.group_by}s" * (strip.num_groups > 1)
    return f"{strip.name}: {strip.num_rows} row{'s' * (strip.num_rows > 1)}{groups}"


def to_image(pack: Pack, found: Sequence[Strip], num_all: int, *, side: int = 96) -> Image.Image:
    """All strips in one image."""
    left_out = f"; {num_all - len(found)} more not shown" * (num_all > len(found))
    title = f"{pack.spec.name}, {pack.num} rows at {pack.size} px; each pair: {contents(pack)}{left_out}"
    blocks = [Block(heading(strip, pack), [Tile(pair(pack, int(row), side)) for row in strip.rows]) for strip in found]
    return draw(title, blocks)


def suspicious(pack: Pack, findings: Sequence[Finding]) -> list[Block]:
    """Return a block per finding of ``data check`` that lists rows. Without any, one block of rows drawn at random."""
    order = f"each pair: {contents(pack)}"
    wrong = [f for f in findings if f.rows and f.verdict in ("look", "broken")]
    if wrong:
        return [
            Block(f"{f.verdict}: {f.item}. {f.evidence} ({order})", _tiles(pack, f.rows[:NUM_SHOWN])) for f in wrong
        ]
    num = min(NUM_SAMPLE, pack.num)
    rows = np.sort(np.random.default_rng(0).choice(pack.num, num, replace=False))
    return [Block(f"No suspicious rows. {num} of {pack.num} rows, drawn at random ({order})", _tiles(pack, rows))]


def _tiles(pack: Pack, rows: Sequence[int] | np.ndarray) -> list[Tile]:
    ids, splits = pack.column("id").astype(str), pack.column("split").astype(str)
    return [Tile(pair(pack, int(row), SIDE), f"{ids[row]} {splits[row]}") for row in rows]
