"""The doctor's contact sheet: the suspicious rows of each finding, or a sample of the data if there are none."""

from collections.abc import Sequence

import numpy as np

from mvitac.data.checks.finding import Finding
from mvitac.data.image_grid import Block, Tile, contents, pair
from mvitac.data.pack import Pack

SIDE, NUM_SHOWN, NUM_SAMPLE = 96, 8, 24  # pixels; rows shown of a finding; rows shown if nothing is suspicious


def blocks_of(pack: Pack, findings: Sequence[Finding]) -> list[Block]:
    """Return a block per finding that lists rows. Without any, one block of rows drawn at random."""
    order = f"each pair: {contents(pack)}"
    blocks = [
        Block(f"{f.verdict}: {f.item}. {f.evidence} ({order})", _tiles(pack, f.rows[:NUM_SHOWN]))
        for f in findings
        if f.rows and f.verdict in ("look", "broken")
    ]
    if blocks:
        return blocks
    num = min(NUM_SAMPLE, pack.num)
    rows = np.sort(np.random.default_rng(0).choice(pack.num, num, replace=False))
    return [Block(f"No suspicious rows. {num} of {pack.num} rows, drawn at random ({order})", _tiles(pack, rows))]


def _tiles(pack: Pack, rows: Sequence[int] | np.ndarray) -> list[Tile]:
    ids, splits = pack.column("id").astype(str), pack.column("split").astype(str)
    return [Tile(pair(pack, int(row), SIDE), f"{ids[row]} {splits[row]}") for row in rows]
