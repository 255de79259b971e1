"""Recordings: every frame has its number, its time and the answer that the engine gives for it."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import h5py
import numpy as np
import pyarrow.csv
import pytest
from PIL import Image

from mvitac.cli.live import _opened
from mvitac.cli.main import main
from mvitac.data.build import build
from mvitac.data.images import difference, fit
from mvitac.data.pack import Pack
from mvitac.data.video import frames
from mvitac.datasets.folder import FolderConfig
from mvitac.deploy.engine import Engine
from mvitac.live.cameras import Recording, recording
from mvitac.live.contact import LiveConfig
from mvitac.live.predictor import Live
from mvitac.live.recordings import Recordings, answers, pack_tables
from mvitac.live.streams import CaptureThread, Stream
from support.videos import write_video

NUM, FREE, FIRST = 50, 20, LiveConfig(calibration=8)


@pytest.fixture(scope="module")
def films(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder, noise = tmp_path_factory.mktemp("films"), np.random.default_rng(0).integers(0, 4, (NUM, 120, 160, 3))

    def touch(number: int) -> np.ndarray:
        image = np.full((120, 160, 3), 100) + noise[number]
        if number >= FREE:
            image[30:90, 40:120] += 80
        return image.astype(np.uint8)

    write_video(folder / "touch.mp4", NUM, touch)
    write_video(folder / "vision.mp4", 24, lambda number: np.full((120, 160, 3), 10 * number, np.uint8), rate=12)
    return {m: folder / f"{m}.mp4" for m in ("vision", "touch")}


def opened(films: dict[str, Path]) -> dict[str, list[Recording]]:
    return {m: [recording(str(path))] for m, path in films.items()}


def whole(tables: Any) -> dict[str, np.ndarray]:
    found = list(tables)
    return {name: np.concatenate([table[name] for table in found]) for name in found[0]}


def test_every_frame_is_answered_as_the_engine_answers_it(engine: Engine, films: dict[str, Path]) -> None:
    """With the nearest frame of the camera, and contact known from the first frame on."""
    table = whole(Recordings(engine, opened(films), FIRST).tables())
    assert table["frame"].tolist() == list(range(NUM)) and table["time"] == pytest.approx(np.arange(NUM) / 25)
    assert table["contact"].tolist() == [False] * FREE + [True] * (NUM - FREE)
    assert table["touch"].tolist() == [0] * FREE + [1] * (NUM - FREE)
    images = {m: dict(frames(path, range(NUM), lost={})) for m, path in films.items()}
    for number in (0, 7, 33, NUM - 1):
        nearest = min(images["vision"], key=lambda i: abs(i / 12 - number / 25))
        pair = {"vision": images["vision"][nearest], "touch": images["touch"][number]}
        p = engine(**{m: fit(image, 32)[None] for m, image in pair.items()})["probability_pattern"][0]
        names = [f"pattern.{name}" for name in engine.classes["pattern"]]
        assert [table[name][number] for name in names] == pytest.approx(p, abs=1e-5)
        assert f"pattern.{table['pattern'][number]}" == names[p.argmax()]
        assert table["pattern.confidence"][number] == pytest.approx(p.max(), abs=1e-5)


def test_damaged_frames_are_left_out(engine: Engine, films: dict[str, Path], tmp_path: Path) -> None:
    """And named; 2.png comes before 10.png, as in a pack."""
    for number in range(NUM):
        Image.fromarray(np.full((32, 32, 3), 100 if number < FREE else 160, np.uint8)).save(tmp_path / f"{number}.png")
    (tmp_path / "3.png").write_bytes(b"damaged")
    hurt = Recordings(engine, opened(films) | {"touch": [recording(f"{tmp_path}@25")]}, FIRST)
    table = whole(hurt.tables())
    assert table["frame"].tolist() == [i for i in range(NUM) if i != 3] and hurt.left_out == 1
    assert table["time"][3] == pytest.approx(4 / 25) and table["contact"].sum() == NUM - FREE
    ((text, first),) = hurt.told.items()
    assert "3.png" in text and first == 3
    early = LiveConfig(calibration=FREE + 5)
    told = Recordings(engine, opened(films) | {"touch": [recording(f"{tmp_path}@25")]}, early).told
    assert told["touch 0 was touched or moved: contact is learned from later frames, or give --background"] == FREE + 5


def test_pictures_named_by_their_time_are_at_it(tmp_path: Path) -> None:
    for time in (1_700_000_000.25, 1_700_000_000.5, 1_700_000_020):
        Image.new("RGB", (8, 8)).save(tmp_path / f"{time}.png")
    assert (recording(str(tmp_path)).times - 1_700_000_000).tolist() == [0.25, 0.5, 20]
    assert recording(f"{tmp_path}@5").times.tolist() == [0, 0.2, 0.4]
    (tmp_path / "free.png").write_bytes(b"")
    with pytest.raises(ValueError, match="image 'free' has no time in its name"):
        recording(str(tmp_path))
    for number in (1, 2, 3):
        (tmp_path / f"{number}.png").write_bytes(b"")
    assert recording(str(tmp_path)).times[1] == 1 / 30


def test_recordings_are_played_at_their_times(engine: Engine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The camera begins two seconds after the gel, whose frames have a gap."""
    for name, times in {"vision": (2, 2.5), "touch": (0, 0.5, 5), "late": (6, 7)}.items():
        (tmp_path / name).mkdir()
        for time in times:
            Image.new("RGB", (8, 8)).save(tmp_path / name / f"{1_700_000_000 + time}.png")
    played: dict[str, list[float]] = {}
    streams: Any = {m: [Stream(m, recording(str(tmp_path / m)))] for m in engine.inputs}
    Live(engine, streams)
    for m, (stream,) in streams.items():
        clock, played[m] = SimpleNamespace(now=40.0), []
        thread = CaptureThread(stream, lambda m=m, clock=clock: played[m].append(clock.now - 40))
        monkeypatch.setattr("mvitac.live.streams.time", SimpleNamespace(monotonic=lambda clock=clock: clock.now))
        thread.stopping = SimpleNamespace(wait=lambda wait, clock=clock: setattr(clock, "now", clock.now + wait))  # type: ignore[assignment]
        thread.run()
    assert played == {"vision": pytest.approx([2, 2.5, 2.6]), "touch": pytest.approx([0, 0.5, 5, 5.1])}  # .1: it ends
    streams["vision"] = [Stream("vision", recording(str(tmp_path / "late")))]
    with pytest.raises(ValueError, match=r"touch ends at 1700000005.00 s, .*late begins at 1700000006.00 s"):
        Live(engine, streams)


def test_names_of_ours_and_of_others_are_not_taken(engine: Engine, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engine, "classes", {"contact": ["edge", "confidence"]})
    target = {"name": "force", "unit": "N", "edges": [], "spread": [0.5]}
    monkeypatch.setattr(engine, "values", {"a": [target], "b": [target]})
    found = answers(engine, {"probability_contact": np.eye(2), "value_a": np.ones((2, 1)), "value_b": np.zeros((2, 1))})
    assert [*found] == [
        *("contact (label)", "contact.confidence", "contact.edge", "contact.confidence (class)"),
        *("force [N]", "force.spread [N]", "force [N] (b)", "force.spread [N] (b)"),
    ]


def test_differences_need_the_free_gel(engine: Engine, films: dict[str, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    """Wherever it is shown; a recording that is in contact from end to end needs an image of it."""
    monkeypatch.setattr(engine, "difference", True)
    first = next(frames(films["touch"], [0]))[1]
    for config, free in ((FIRST, ()), (LiveConfig(calibration=NUM + 1), [first])):
        rows = list(Recordings(engine, opened(films), config, free)._rows())
        assert len(rows) == NUM and rows[0][4]["touch"][16, 16].mean() == pytest.approx(128, abs=3)
        assert rows[-1][4]["touch"][16, 16].mean() == pytest.approx(168, abs=3)
    last = difference(fit(next(frames(films["touch"], [NUM - 1]))[1], 32), fit(first, 32))
    assert np.abs(rows[-1][4]["touch"].astype(int) - last).max() <= 2
    with pytest.raises(ValueError, match="give --background"):
        Recordings(engine, opened(films), LiveConfig(calibration=NUM + 1))


def test_a_pack_is_answered_row_by_row(engine: Engine, pack: Pack, monkeypatch: pytest.MonkeyPatch) -> None:
    table = whole(pack_tables(engine, pack))
    assert table["frame"].tolist() == list(range(pack.num)) and table["id"].tolist() == pack.column("id").tolist()
    outputs = engine(**{m: pack.images[m][100:110] for m in engine.inputs})
    assert table["pattern.rows"][100:110] == pytest.approx(outputs["probability_pattern"][:, 1], abs=1e-5)
    monkeypatch.setattr(engine, "difference", True)
    with pytest.raises(ValueError, match="minus its background in the model only"):
        next(pack_tables(engine, pack))


def test_values_have_their_unit_and_spread(value_onnx: Path, measured: Pack) -> None:
    engine = Engine(value_onnx, threads=1)
    table, target = whole(pack_tables(engine, measured)), engine.values["both"][1]
    outputs = engine(**{m: measured.images[m][:8] for m in engine.inputs})
    assert table["both.weight [N]"][:8] == pytest.approx(outputs["value_both"][:, 1], abs=1e-4)
    assert set(table["both.weight.spread [N]"].tolist()) <= set(target["spread"])


def test_predict_command(
    onnx: Path, films: dict[str, Path], pack: Pack, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command, out = ["predict", str(onnx)], tmp_path / "p.csv"
    both = ["--vision", str(films["vision"]), "--touch", str(films["touch"])]
    assert main([*command, *both, "--out", str(out), "--calibration", "8"]) == 0
    assert "50 frames" in capsys.readouterr().err
    table = pyarrow.csv.read_csv(out)
    assert table.column_names[:5] == ["frame", "time", "contact", "touch", "pattern"] and table.num_rows == NUM
    assert table.column("contact").to_pylist() == [False] * FREE + [True] * (NUM - FREE)
    short = write_video(tmp_path / "short.mp4", 12, lambda number: np.zeros((120, 160, 3), np.uint8), rate=12)
    assert main([*command, "--vision", str(short), *both[2:], "--out", str(out)]) == 0
    said = capsys.readouterr().err
    assert "p.csv, 36 frames" in said and "14 frames are left out" in said  # half a second after the camera's last
    assert pyarrow.csv.read_csv(out).column("frame").to_pylist() == list(range(36))
    for times, words in ((range(12), "p.csv, 50 frames"), ([-9, *range(99, 110)], "50 frames are left out")):
        (tmp_path / "short_timestamps.txt").write_text("\n".join(map(str, times)))
        main([*command, "--vision", str(short), *both[2:], "--out", str(out)])
        assert words in capsys.readouterr().err
    assert main([*command, str(pack.path), "--out", str(out)]) == 0 and pyarrow.csv.read_csv(out).num_rows == pack.num
    for m in ("vision", "touch"):
        Image.fromarray(pack.images[m][7]).save(tmp_path / f"{m}.png")
    (tmp_path / "pairs.csv").write_text("vision,gel\nvision.png,touch.png\n")
    assert main([*command, str(tmp_path / "pairs.csv"), "--touch", "gel", "--out", str(tmp_path / "one.csv")]) == 0
    one, row = pyarrow.csv.read_csv(tmp_path / "one.csv"), pyarrow.csv.read_csv(out).slice(7, 1)
    assert one.column("pattern.rows").to_pylist() == pytest.approx(row.column("pattern.rows").to_pylist(), abs=1e-5)
    assert "split" in row.column_names and not {"group", "split"} & {*one.column_names}  # made up for a new table
    assert "warning" not in capsys.readouterr().err
    (tmp_path / "some.csv").write_text("vision,touch,sensor\nvision.png,touch.png,new\n,touch.png,new\n")
    crop: Any = {"crop": ("touch=0:0:16:16",), "allow_missing": True, "allow_leak": True}
    some = FolderConfig(path=tmp_path / "some.csv", size=32, **crop).source()
    for side in (32, 16):
        build(some, tmp_path / f"some{side}", size=side, quiet=True)
    assert main([*command, str(tmp_path / "some32"), "--out", str(out)]) == 0
    said = capsys.readouterr().err
    assert "1 of 2 rows are left out" in said and "touch sensor new is new to the model, which knows" in said
    assert "touch shows 0:0:16:16, the model learned from whole images" in said
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["data/lost/force"] = np.arange(3)
        for m in pack.images:
            file[f"data/demo/{m}"] = pack.images[m][:3]
    assert main([*command, str(tmp_path / "a.h5"), "--out", str(out)]) == 0
    assert "note: a.h5: data/lost is left out: it has no images" in capsys.readouterr().err
    (tmp_path / "free.csv").write_text("touch,background\ntouch.png,touch.png\n")
    minus = SimpleNamespace(inputs={"touch": (32, 32, 3)}, difference=True)  # of a model of difference images
    own = _opened(FolderConfig(path=tmp_path / "free.csv", allow_leak=True), {"vision": (), "touch": ()}, minus)
    assert own.spec.difference and (own.images["touch"] == 128).all()
    (tmp_path / "gel.csv").write_text("touch\ntouch.png\n")
    Image.fromarray(pack.images["touch"][8]).save(tmp_path / "other.png")
    (two := tmp_path / "two.csv").write_text("vision,left,right\nvision.png,touch.png,other.png\n")
    (empty := tmp_path / "empty").mkdir()
    for words, says in {
        (): "give one SOURCE",
        (str(films["touch"]), *both): "give one SOURCE",
        (str(films["touch"]),): "takes vision and touch",
        tuple(both[2:]): "the model takes {'vision': 1, 'touch': 1}",
        ("--vision", "0", *both[2:]): "give a video",
        (str(empty),): "holds no pictures",
        (str(tmp_path / "some16"),): "some16 has images of vision of (16, 16, 3), the model takes (32, 32, 3)",
        (str(two),): f"error: {two} has images of touch of (32, 32, 6), the model takes (",
        (str(tmp_path / "gel.csv"),): "has no vision, which the model takes too",
    }.items():
        assert main([*command, *words, "--out", str(out)]) == 2 and says in capsys.readouterr().err


def test_a_crop_is_what_the_model_sees(engine: Engine, films: dict[str, Path], tmp_path: Path) -> None:
    """Of frames and of the image without contact; one that is larger than the frames is no frame."""
    part, folder = (slice(30, 90), slice(40, 120)), tmp_path / "cut"
    folder.mkdir()
    for number, image in frames(films["touch"], range(NUM)):
        Image.fromarray(image[part]).save(folder / f"{number:03}.png")
    free, tables = [next(iter(frames(films["touch"], [0])))[1]], []
    for text, background in ((f"{films['touch']}#40:30:80:60", free), (f"{folder}@25", [free[0][part]])):
        files = {"vision": [recording(str(films["vision"]))], "touch": [recording(text)]}
        tables.append(whole(Recordings(engine, files, LiveConfig(), background).tables()))
    assert all(np.array_equal(values, tables[1][name]) for name, values in tables[0].items())
    assert tables[0]["contact"].sum() == NUM - FREE
    large = Recordings(engine, opened(films) | {"touch": [recording(f"{films['touch']}#100:0:80:60")]}, LiveConfig())
    assert not list(large.tables()) and "crop 100:0:80:60 reaches beyond 160 x 120" in next(iter(large.told))


def test_images_that_change_in_size_are_told(engine: Engine, films: dict[str, Path], tmp_path: Path) -> None:
    for number in range(NUM):
        Image.fromarray(np.full((32 + 8 * (number > 30),) * 2 + (3,), 100, np.uint8)).save(tmp_path / f"{number}.png")
    changed = Recordings(engine, opened(films) | {"touch": [recording(f"{tmp_path}@25")]}, FIRST)
    assert whole(changed.tables())["frame"].tolist() == [*range(NUM)]
    ((text, first),) = changed.told.items()
    assert text.startswith("touch 0 changed from 32x32 to 40x40") and first == 31
