"""Frame i is frame i, whatever the codec does to the order; each is decoded once; damage is told, never painted over."""

import random
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from PIL import Image

from mvitac.data import video
from mvitac.data.video import frames, num_frames
from support.videos import edited, film, numbered, read_number, write_video

NUM = 150
KINDS: dict[str, tuple[str, dict[str, Any]]] = {
    "mpeg4": ("v.mp4", {}),
    "mpeg4-reordered": ("v.mp4", {"b_frames": 2}),
    "avi": ("v.avi", {}),
    "avi-reordered": ("v.avi", {"b_frames": 2}),
    "mov": ("v.mov", {"gop": 1000}),  # one key frame for all
    "mjpeg": ("v.avi", {"codec": "mjpeg"}),
    "h264": ("v.mp4", {"codec": "libx264", "gop": 40, "b_frames": 3}),
    "h264-mkv": ("v.mkv", {"codec": "libx264", "gop": 40, "b_frames": 3}),  # its first packets have no decoding times
    "h264-open": ("v.mp4", {"codec": "libx264", "b_frames": 3, "options": {"x264-params": "open-gop=1:keyint=20"}}),
}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("videos")
    return {
        name: write_video(folder / name / file, NUM, lambda i: numbered(i, "touch"), **options)
        for name, (file, options) in KINDS.items()
        if options.get("codec", "mpeg4") in av.codecs_available
    }


@pytest.fixture(params=KINDS)
def path(request: pytest.FixtureRequest, made: dict[str, Path]) -> Path:
    if request.param not in made:
        pytest.skip("this PyAV cannot encode it")
    return made[request.param]


def packets_of(path: Path) -> list[tuple[int, int]]:
    with av.open(str(path)) as container:
        return [(p.pos or 0, p.size) for p in container.demux(video=0) if p.size]


def copy_with(path: Path, out: Path, at: int, data: bytes) -> Path:
    whole = bytearray(path.read_bytes())
    whole[at : at + len(data)] = data
    out.write_bytes(whole)
    return out


def test_every_frame_is_the_one_it_says(path: Path) -> None:
    assert num_frames(path) == NUM
    found = list(frames(path, range(NUM)))
    assert [number for number, _ in found] == list(range(NUM))
    assert [read_number(image) for _, image in found] == [(i, "touch") for i in range(NUM)]


@pytest.mark.parametrize("seed", range(4))
def test_any_choice_of_frames_is_the_one_it_says(path: Path, seed: int) -> None:
    wanted = (rng := random.Random(seed)).sample(range(NUM), rng.choice((1, 2, 7, 40)))
    found = list(frames(path, wanted, 48))
    assert [number for number, _ in found] == sorted(wanted)
    for number, image in found:
        assert image.shape == (48, 48, 3) and image.dtype == np.uint8 and read_number(image)[0] == number


@pytest.mark.parametrize("kind", ["mpeg4", "mpeg4-reordered", "mov", "h264", "h264-open"])
@pytest.mark.parametrize(("first", "num"), [(1, 149), (43, 107), (0, 33)])
def test_a_trim_counts_what_is_shown(made: dict[str, Path], tmp_path: Path, kind: str, first: int, num: int) -> None:
    if kind not in made:
        pytest.skip("this PyAV cannot encode it")
    path = edited(made[kind], tmp_path / "v.mp4", (first, num))
    with av.open(str(path)) as container:
        shown = [(frame.time, frame.to_ndarray(format="rgb24")) for frame in container.decode(video=0)]
    assert [read_number(image)[0] for _, image in shown] == [*range(first, first + num)]
    assert num_frames(path) == num and np.allclose(video.frame_times(path), [time for time, _ in shown])
    for wanted in ([0], [1, 2, 30], range(num)):
        found = list(frames(path, wanted))
        assert [number for number, _ in found] == list(wanted)
        assert all(np.array_equal(image, shown[number][1]) for number, image in found)


def test_pieces_put_together_without_encoding_anew_are_refused(made: dict[str, Path], tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"v\.mp4 is put together from pieces by an edit list: encode it again"):
        num_frames(edited(made["mpeg4"], tmp_path / "v.mp4", (31, 20), (5, 10)))


def test_shrinking_is_that_of_pillow(made: dict[str, Path]) -> None:
    rng = np.random.default_rng(0)
    small = rng.integers(40, 215, (12, 16, 1), np.uint8).repeat(3, 2)  # gray: codecs store colour more coarsely
    path = write_video(made["mpeg4"].with_name("noise.mp4"), 1, lambda _: small.repeat(10, 0).repeat(10, 1))
    (_, whole), (_, shrunk) = *frames(path, [0]), *frames(path, [0], 50)
    expected = np.asarray(Image.fromarray(whole).resize((50, 50), Image.Resampling.BILINEAR)).astype(int)
    assert np.abs(shrunk - expected).mean() < 2
    nearest = np.asarray(Image.fromarray(whole).resize((50, 50), Image.Resampling.NEAREST)).astype(int)
    assert np.abs(shrunk - nearest).mean() > 5  # dropping pixels would show


def test_frames_are_upright(tmp_path: Path) -> None:
    """The header says that players turn a quarter clockwise, as a telephone's do."""
    path, one = write_video(tmp_path / "a.mp4", 1, lambda i: numbered(i, "touch")), (1 << 16).to_bytes(4, "big")
    ((_, plain),) = frames(path, [0])
    matrix = one + bytes(12) + one
    turned = bytes(4) + one + bytes(4) + (-1 << 16).to_bytes(4, "big", signed=True) + bytes(4)
    whole = path.read_bytes()
    at = whole.index(matrix, whole.index(b"tkhd"))
    ((_, upright),) = frames(copy_with(path, tmp_path / "b.mp4", at, turned), [0])
    assert (upright == np.rot90(plain, -1)).all()


def test_one_forward_pass_decodes_no_frame_twice_and_skips(
    made: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    count = {"runs": 0, "packets": 0}
    start, decode = video._Run.__init__, video._Run._decoded

    def counting_start(self: Any, *args: Any) -> None:
        count["runs"] += 1
        start(self, *args)

    def counting_decode(self: Any, packet: Any) -> Any:
        count["packets"] += packet is not None
        return decode(self, packet)

    monkeypatch.setattr(video._Run, "__init__", counting_start)
    monkeypatch.setattr(video._Run, "_decoded", counting_decode)
    next(found := frames(made["mpeg4"], range(NUM)))
    assert count["packets"] <= 2  # each comes as it is decoded
    assert len(list(found)) == NUM - 1 and count == {"runs": 1, "packets": NUM}
    count.update(runs=0, packets=0)
    touches = [*range(20, 50), *range(100, 130)]  # key frames are at 0, 12, 24, ...
    assert [number for number, _ in frames(made["mpeg4"], touches)] == touches
    assert count == {"runs": 2, "packets": (50 - 12) + (130 - 96)}


@pytest.mark.parametrize("harm", ["zeros", "noise", "bit"])
def test_a_damaged_packet_costs_frames_up_to_the_next_key_frame(path: Path, tmp_path: Path, harm: str) -> None:
    good = dict(frames(path, range(NUM)))
    at, size = packets_of(path)[75]
    if path.suffix == ".mkv":  # the place is that of a header without which the packet is not there
        at, size = at + 16, size - 16
    whole = path.read_bytes()[at : at + size]
    middle = size // 2
    data = {
        "zeros": bytes(size),
        "noise": np.random.default_rng(1).bytes(size),
        "bit": whole[:middle] + bytes([whole[middle] ^ 16]) + whole[middle + 1 :],
    }[harm]
    hurt = copy_with(path, tmp_path / path.name, at, data)
    lost: dict[int, str] = {}
    found = dict(frames(hurt, range(NUM), lost=lost))
    assert sorted({*found, *lost}) == list(range(NUM)) and not {*found} & {*lost}
    # One bit may be harmless to the picture; anything that is shown must be right.
    assert all(np.abs(image.astype(int) - good[number]).max() < 40 for number, image in found.items())
    assert all(read_number(image)[0] == number for number, image in found.items())
    if harm != "bit":
        assert lost
        with pytest.raises(ValueError, match=f"frame {min(lost)} cannot be decoded|frame {min(lost)} is beyond"):
            list(frames(hurt, range(NUM)))


def test_a_lost_chunk_shifts_no_number(made: dict[str, Path], tmp_path: Path) -> None:
    at, size = packets_of(made["avi"])[75]
    hurt = copy_with(made["avi"], tmp_path / "v.avi", at + 8, bytes(size))  # into the next chunk's header
    lost: dict[int, str] = {}
    found = {number: read_number(image)[0] for number, image in frames(hurt, range(NUM), lost=lost)}
    assert found == {number: number for number in found} and {*range(75)} <= {*found} and 76 in lost
    assert any("disagree" in why for why in lost.values())
    again = frames(hurt, [100], lost=lost)  # found through the table, behind the damage
    assert [read_number(image)[0] for _, image in again] == [100]


def test_a_file_cut_off_behind_its_table_gives_what_it_holds(tmp_path: Path) -> None:
    path = write_video(tmp_path / "v.mp4", NUM, lambda i: numbered(i, "touch"), flags={"movflags": "faststart"})
    (tmp_path / "cut.mp4").write_bytes(path.read_bytes()[: packets_of(path)[80][0]])
    lost: dict[int, str] = {}
    found = dict(frames(tmp_path / "cut.mp4", range(70, 90), lost=lost))
    assert {*range(70, 80)} == {*found} and {*range(80, 90)} == {*lost}
    with pytest.raises(ValueError, match="frame 85 is beyond the end of what can be read: the file is cut off"):
        list(frames(tmp_path / "cut.mp4", [85]))


def test_frames_that_are_not_there(made: dict[str, Path]) -> None:
    with pytest.raises(ValueError, match="frame 150 is wanted, the video ends after frame 149"):
        list(frames(made["mpeg4"], [3, 150]))
    with pytest.raises(ValueError, match="frame -1 is wanted: frames are counted from 0"):
        list(frames(made["mpeg4"], [-1]))
    lost: dict[int, str] = {}
    assert [i for i, _ in frames(made["mpeg4"], [149, 150, 900], lost=lost)] == [149] and sorted(lost) == [150, 900]


def test_files_that_are_no_videos(made: dict[str, Path], tmp_path: Path) -> None:
    short = write_video(tmp_path / "v.mkv", 2, lambda i: numbered(i, "touch"))
    (tmp_path / "cut.mkv").write_bytes(short.read_bytes()[:700])
    with pytest.raises(ValueError, match=r"cut\.mkv holds no frames: it is damaged or cut off"):
        video.frame_times(tmp_path / "cut.mkv")
    whole = made["mpeg4"].read_bytes()  # half of it lacks its table
    for name, data in (("empty.mp4", b""), ("cut.mp4", whole[: len(whole) // 2])):
        (tmp_path / name).write_bytes(data)
        with pytest.raises(ValueError, match=rf"{name} cannot be read as a video .* damaged or cut off"):
            num_frames(tmp_path / name)
    said = []
    for cut in range(100, 3000, 100):  # what is lost may be shown before what is left
        (end := tmp_path / f"{cut}.mkv").write_bytes(made["h264-mkv"].read_bytes()[:-cut])
        try:
            assert num_frames(end) and np.diff(video.frame_times(end)).max() < 0.06
        except ValueError as error:
            said.append("lacks frames after" in str(error))
    assert any(said)
    (tmp_path / "part.mkv").write_bytes(made["h264-mkv"].read_bytes()[:-4000])
    with pytest.raises(ValueError, match=r"part\.mkv ends after \d\.\d s of 00:00:.*: it is cut off"):
        num_frames(tmp_path / "part.mkv")
    (tmp_path / "codec.mp4").write_bytes(made["h264"].read_bytes().replace(b"avc1\0", b"zzzz\0"))
    with pytest.raises(ValueError, match=r"codec\.mp4 holds no video that can be decoded"):
        num_frames(tmp_path / "codec.mp4")
    with pytest.raises(FileNotFoundError, match=r"gone\.mp4"):
        num_frames(tmp_path / "gone.mp4")
    with av.open(str(tmp_path / "sound.mp4"), "w") as container:
        stream = container.add_stream("aac", rate=48000)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
        frame.sample_rate = 48000
        for packet in [*stream.encode(frame), *stream.encode(None)]:
            container.mux(packet)
    with pytest.raises(ValueError, match="holds no video"):
        num_frames(tmp_path / "sound.mp4")


def test_a_playlist_is_no_video(tmp_path: Path) -> None:
    """It would show files elsewhere, itself without end, and other frames than the cache knows."""
    film(tmp_path / "a.mp4", 5)
    (tmp_path / "list.mp4").write_text("ffconcat version 1.0\nfile a.mp4\n")
    assert num_frames(tmp_path / "a.mp4") == 5
    with pytest.raises(ValueError, match=r"list\.mp4 cannot be read as a video"):
        num_frames(tmp_path / "list.mp4")
