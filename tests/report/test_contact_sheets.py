"""The contact sheet: every class there, groups spread, each pixel where its row says, gaps shown as gaps."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mvitac.cli.main import main
from mvitac.data.build import build
from mvitac.data.pack import Pack
from mvitac.data.source import Sample
from mvitac.report import contact_sheet
from mvitac.report.contact_sheet import pair
from support.toy import Toy


def test_strips_hold_their_class_and_spread_over_groups(pack: Pack) -> None:
    found, num_all = contact_sheet.strips(pack, num=20)
    assert [heading for heading, _ in found] == [f"{n}: 40 rows, 20 instances" for n in ("columns", "rows", "checks")]
    assert num_all == 3
    for label, (_, rows) in enumerate(found):
        assert (pack.column("label_pattern")[rows] == label).all()
        assert len(set(pack.column("group")[rows])) == 20
    again, other = (contact_sheet.strips(pack, num=20, seed=seed)[0] for seed in (0, 1))
    assert all((a == b).all() for (_, a), (_, b) in zip(found, again, strict=True))
    assert any((a != b).any() for (_, a), (_, b) in zip(found, other, strict=True))


def test_strips_by_column_and_split(pack: Pack) -> None:
    found, num_all = contact_sheet.strips(pack, "group", num=9)
    assert len(found) == 40 and num_all == 60
    assert all(len(rows) == 2 for _, rows in found)
    tested, _ = contact_sheet.strips(pack, "bright", split="test", num=50)
    assert set(pack.column("split")[np.concatenate([rows for _, rows in tested])]) == {"test"}
    for options, says in (({"by": "patern"}, "did you mean 'pattern'"), ({"split": "dev"}, "no rows in split dev")):
        with pytest.raises(ValueError, match=says):
            contact_sheet.strips(pack, **options)


def places(picture: np.ndarray, image: np.ndarray) -> list[tuple[int, int]]:
    """Where ``image`` is in ``picture``: (top, left)."""
    height, width = image.shape[:2]
    corners = np.argwhere((picture[: 1 - height, : 1 - width] == image[0, 0]).all(2)).tolist()
    return [(y, x) for y, x in corners if np.array_equal(picture[y : y + height, x : x + width], image)]


@pytest.mark.parametrize("touch_channels", [3, 6])
def test_pixels_lie_where_they_should(tmp_path: Path, touch_channels: int) -> None:
    pack = build(Toy(touch_channels=touch_channels), tmp_path / "p", size=32, quiet=True)
    found, num_all = contact_sheet.strips(pack, num=3)
    picture = np.asarray(contact_sheet.to_image(pack, found, num_all, side=32))
    tops = []
    for _, rows in found:
        for row in rows:
            sensors = np.split(pack.images["touch"][row], touch_channels // 3, axis=2)
            ((top, _),) = places(picture, np.concatenate([pack.images["vision"][row], *sensors], axis=1))
            tops.append(top)
    assert tops == sorted(tops) and len(set(tops)) == 3  # a line per class


@dataclass
class Holes(Toy):
    def read(self, item: int) -> list[Sample]:
        (s,) = super().read(item)
        columns = {**s.columns, "has_touch": item != 4}
        return [Sample(vision=s.vision, touch=None if item == 4 else s.touch, columns=columns)]


def test_a_gap_is_crossed_out(tmp_path: Path) -> None:
    pack = build(Holes(), tmp_path / "p", size=32, quiet=True)
    gap, whole = (pair(pack, row, 32)[:, 32:] for row in (4, 5))
    assert (gap[1, 15] == 225).all() and (gap[16, 16] < 200).all()
    assert (whole == pack.images["touch"][5]).all()


def test_the_command_writes_a_picture(pack: Pack, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["data", "show", str(pack.path), "--num", "2"]) == 0
    with Image.open(tmp_path / f"{pack.path.name}.png") as picture:
        assert picture.width >= 480
