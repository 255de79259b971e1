"""The contact sheet: every class there, groups spread, each pixel where its row says, gaps shown as gaps."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mvitac.cli.main import main
from mvitac.data.build import build
from mvitac.data.image_grid import pair
from mvitac.data.pack import Pack
from mvitac.data.source import Sample
from mvitac.report import contact_sheet
from support.toy import Toy


def test_strips_hold_their_class_and_spread_over_groups(pack: Pack) -> None:
    found, num_all = contact_sheet.strips(pack, num=20)
    assert [strip.name for strip in found] == ["columns", "rows", "checks"]
    assert num_all == 3
    for label, strip in enumerate(found):
        assert (pack.column("label_pattern")[strip.rows] == label).all()
        assert len(set(pack.column("group")[strip.rows])) == 20
        assert strip.num_rows == 40 and strip.num_groups == 20
    again = contact_sheet.strips(pack, num=20)[0]
    assert all((a.rows == b.rows).all() for a, b in zip(found, again, strict=True))
    assert any(
        (a.rows != b.rows).any() for a, b in zip(found, contact_sheet.strips(pack, num=20, seed=1)[0], strict=True)
    )


def test_strips_by_column_and_split(pack: Pack) -> None:
    found, num_all = contact_sheet.strips(pack, "group", limit=7, num=9)
    assert len(found) == 7 and num_all == 60
    assert all(len(strip.rows) == 2 for strip in found)
    tested, _ = contact_sheet.strips(pack, "bright", split="test", num=50)
    assert set(pack.column("split")[np.concatenate([s.rows for s in tested])]) == {"test"}
    for options, says in (({"by": "patern"}, "did you mean 'pattern'"), ({"split": "dev"}, "unknown split 'dev'")):
        with pytest.raises(ValueError, match=says):
            contact_sheet.strips(pack, **options)


@pytest.mark.parametrize("touch_channels", [3, 6])
def test_pixels_lie_where_they_should(tmp_path: Path, touch_channels: int) -> None:
    pack = build(Toy(touch_channels=touch_channels), tmp_path / "p", size=32, quiet=True)
    found, num_all = contact_sheet.strips(pack, num=3)
    picture = np.asarray(contact_sheet.to_image(pack, found, num_all, side=32))
    positions = np.lib.stride_tricks.sliding_window_view(picture, (32, 32, 3))[:, :, 0]
    places = []
    for strip in found:
        for row in strip.rows:
            images = [pack.images["vision"][row], *np.split(pack.images["touch"][row], touch_channels // 3, axis=2)]
            there = [np.argwhere((positions == image).all((2, 3, 4))).tolist() for image in images]
            assert all(len(hits) == 1 for hits in there)
            (top, left), *others = (hits[0] for hits in there)
            assert others == [[top, left + 32 * k] for k in range(1, len(images))]
            places.append((top, left))
    assert places == sorted(places) and len({top for top, _ in places}) == 3  # a line per class


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


def test_the_command_writes_png_and_html(pack: Pack, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["data", "show", str(pack.path), "--num", "2"]) == 0
    with Image.open(tmp_path / f"{pack.path.name}.png") as picture:
        assert picture.width >= 480
    assert main(["data", "show", str(pack.path), "--by", "bright", "--num", "2", "--out", "s.html"]) == 0
    text = (tmp_path / "s.html").read_text()
    assert text.count("<img ") == 4 and "dark: " in text and "bright: light" in text
    assert "<script" not in text


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--out", "s.gif"], "ends in .png or .html"),
        (["--side", "4"], "give 16 to 1024 pixels"),
        (["--num", "0"], "give at least 1"),
        (["--by", "nothing"], "unknown task or column 'nothing'"),
        (["--seed", "-1"], "give a number >= 0"),
    ],
)
def test_mistakes_in_one_line(
    pack: Pack, tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], says: str
) -> None:
    extra = [] if "--out" in options else ["--out", str(tmp_path / "s.png")]
    assert main(["data", "show", str(pack.path), *options, *extra]) == 2
    error = capsys.readouterr().err
    assert says in error and error.count("\n") == 1
    assert not list(tmp_path.iterdir())
