"""The contact sheet: every class there, groups spread, each pixel where its row says, gaps shown as gaps."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mvitac.data.build import build
from mvitac.data.pack import Pack
from mvitac.report import contact_sheet
from mvitac.report.contact_sheet import pair
from support.toy import Toy, with_columns


def rows_of(pack: Pack, tiles: Sequence[contact_sheet.Tile]) -> list[int]:
    return [pack.column("id").tolist().index(caption.split()[0]) for _, caption in tiles]


def test_every_class_is_there_and_spread_over_groups_or_else_every_group(pack: Pack) -> None:
    found = contact_sheet.samples(pack)
    assert [heading for heading, _ in found] == [f"{n}: 40 rows, 20 instances" for n in ("columns", "rows", "checks")]
    for label, (_, tiles) in enumerate(found):
        rows = rows_of(pack, tiles)
        assert (pack.column("label_pattern")[rows] == label).all()
        assert len(set(pack.column("group")[rows])) == len(rows) == 6
    *found, last = contact_sheet.samples(with_columns(pack, spec=replace(pack.spec, tasks=())))  # without labels
    assert len(found) == 40 and all(len(tiles) == 2 for _, tiles in found) and last == ("20 more are not shown", [])


def places(picture: np.ndarray, image: np.ndarray) -> list[tuple[int, int]]:
    height, width = image.shape[:2]
    corners = np.argwhere((picture[: 1 - height, : 1 - width] == image[0, 0]).all(2)).tolist()
    return [(y, x) for y, x in corners if np.array_equal(picture[y : y + height, x : x + width], image)]


@pytest.mark.parametrize("touch_channels", [3, 6])
def test_pixels_lie_where_they_should(tmp_path: Path, touch_channels: int) -> None:
    pack = build(Toy(touch_channels=touch_channels), tmp_path / "p", size=32, quiet=True)
    found = contact_sheet.samples(pack)
    picture, tops = np.asarray(contact_sheet.draw("toy", found)), []
    for _, tiles in found:
        for image, row in zip((image for image, _ in tiles), rows_of(pack, tiles), strict=True):
            assert np.array_equal(image, pair(pack, row, 96))
            ((top, _),) = places(picture, image)
            tops.append(top)
    assert tops == sorted(tops) and len(set(tops)) >= 3  # a line per class


def test_a_gap_is_crossed_out(pack: Pack) -> None:
    gap, whole = (pair(with_columns(pack, has_touch=np.arange(pack.num) != 4), row, 32)[:, 32:] for row in (4, 5))
    assert (gap[1, 15] == 225).all() and (gap[16, 16] < 200).all() and (whole == pack.images["touch"][5]).all()
