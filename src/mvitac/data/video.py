"""Reads chosen frames of a video file, each decoded once, in one forward pass.

Frame i is the i-th in display order, from 0. Its position is read from the container's packet table, not computed from a
nominal frame rate. The decoder starts at the last key frame before a run of wanted frames and skips the packets between
runs, so a few touches in an hour of video are cheap.
"""

import contextlib
import functools
import itertools
import os
import re
import sys
from bisect import bisect_left, insort
from collections import deque
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import av
import numpy as np
from av.container import InputContainer
from av.error import FFmpegError
from av.packet import Packet
from av.video.frame import VideoFrame
from av.video.reformatter import Interpolation, VideoReformatter
from av.video.stream import VideoStream

from mvitac.system.files import brief

VIDEOS = (".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v", ".mpg")
FORMATS = "mov,mp4,avi,matroska,webm,mpeg,mpegvideo,mpegts,m4v"  # no playlists, which may name any other file


class Packets(NamedTuple):
    """The packet table of a video, in the order in which packets are stored and decoded.

    Packets cut off by an edit list (a trim without re-encoding) are decoded, because others refer to them, but not
    displayed, so they do not count as frames.
    """

    dts: np.ndarray  # [P] int64 decoding times
    places: np.ndarray  # [P] int64 positions in the file
    keys: np.ndarray  # [K] int64 ascending numbers of the packets at which decoding can start
    before: np.ndarray  # [P + 1] int64 number of frames stored before each packet, and in total

    @property
    def num(self) -> int:
        """Number of displayed frames."""
        return int(self.before[-1])

    def is_at(self, number: int, packet: Packet) -> bool:
        """Whether ``packet`` has the place of packet ``number``, or 8 more, without the header of an AVI chunk."""
        return packet.pos is not None and packet.pos - int(self.places[number]) in {0, 8}

    def start_of(self, frame: int) -> int:
        """The index in ``keys`` of the last key packet with at most ``frame`` frames stored before it."""
        return max(0, int(np.searchsorted(self.before[self.keys], frame, side="right")) - 1)


def num_frames(path: str | Path) -> int:
    """Return the number of frames according to the container; ValueError or OSError if it is not a complete video."""
    return _packets(path).num


def frame_times(path: str | Path) -> np.ndarray:
    """Return the display times in seconds [N], ascending; ValueError or OSError if it cannot be read as a video."""
    with _opened(path) as (container, stream):
        shown = [p.pts for p in container.demux(stream) if p.size and not p.is_discard and p.pts is not None]
        if not shown:
            raise ValueError(f"{path} holds no frames: it is damaged or cut off")
        return np.sort(np.array(shown, float)) * float(stream.time_base or 0)


def spread(num: int, length: int, start: float = 0.0, end: float = 1.0) -> list[int]:
    """Return at most ``num`` distinct frame numbers, evenly spaced between fractions ``start`` and ``end`` of ``length``."""
    return sorted({int(place) for place in np.rint(np.linspace(start * (length - 1), end * (length - 1), num))})


def frames(
    path: str | Path, wanted: Iterable[int], size: int | None = None, *, lost: dict[int, str] | None = None
) -> Iterator[tuple[int, np.ndarray]]:
    """Yield the ``wanted`` frames in ascending order as (i, uint8 RGB [H, W, 3]), resized to ``size`` if it is given.

    ``lost`` receives the reason for each frame that is missing or damaged; without it, such a frame is a ValueError.
    OSError if the file cannot be read.
    """
    left, packets = deque(sorted({int(i) for i in wanted})), _packets(path)
    if left and left[0] < 0:
        raise ValueError(f"{path}: frame {left[0]} is wanted: frames are counted from 0")

    def lose(why: str) -> None:
        if lost is None:
            raise ValueError(f"{path}: frame {left[0]} {why}")
        lost[left.popleft()] = why

    with _opened(path) as (container, stream):
        reformatter = VideoReformatter()  # keeps its tables from frame to frame
        while left and left[0] < packets.num:
            key = packets.start_of(left[0])
            run = _Run(container, stream, packets, key)
            if run.first > left[0] and key:  # the key frame is displayed after the frame that depends on it
                run = _Run(container, stream, packets, key - 1)
            for number, frame in run.frames():
                while left and (left[0] < number or (left[0] == number and run.trouble)):
                    lose(f"cannot be decoded ({run.trouble or 'nothing came out'}): fetch the video again")
                if left and left[0] == number:
                    # Bilinear as Pillow's resize (every source pixel counts), but directly from the decoder's planes.
                    shape = {"width": size or frame.width, "height": size or frame.height}
                    rgb = reformatter.reformat(frame, format="rgb24", interpolation=Interpolation.BILINEAR, **shape)
                    turned = np.rot90(rgb.to_ndarray(), round(frame.rotation / 90))  # upright, as it is played
                    yield left.popleft(), np.ascontiguousarray(turned)
                ahead = packets.start_of(left[0]) if left else key
                if not left or (ahead > key and packets.keys[ahead] > run.fed + 1):
                    break  # nothing more is wanted, or a later key packet is nearer than the next packet
            else:
                while left and left[0] < packets.num:
                    lose("is beyond the end of what can be read: the file is cut off, fetch it again")
        while left:
            lose(f"is wanted, the video ends after frame {packets.num - 1}: is it the right one, and whole?")


class _Run:
    """Decodes from key packet number ``key`` of ``packets`` to the end of the file."""

    def __init__(self, container: InputContainer, stream: VideoStream, packets: Packets, key: int) -> None:
        self._context, self._packets = stream.codec_context, packets
        self._context.flush_buffers()
        self.fed = int(packets.keys[key])  # number of the packet given to the decoder last
        self.trouble = ""  # error in the stream that affects frames up to the next key frame; "" = none
        self._hurt = 0  # display time of the damaged frame
        container.seek(int(packets.dts[self.fed]), stream=stream, backward=True)
        found = itertools.dropwhile(lambda packet: not packets.is_at(self.fed, packet), container.demux(stream))
        self._demuxed = (packet for packet in found if packet.size)
        # Frames displayed before a key frame may be stored directly after it. They refer to packets before the key
        # frame, so they belong to the previous run. Their number determines the frame number of the key frame.
        self._ahead: list[Packet] = []
        for packet in self._demuxed:
            self._ahead.append(packet)
            if _shown(packet) > _shown(self._ahead[0]):
                break
        self._shown = _shown(self._ahead[0]) if self._ahead else 0
        leading = sum(_shown(p) < self._shown and not p.is_discard for p in self._ahead)
        # Frame number of the key frame or, if that is cut off, of the first frame after it.
        self.first = int(packets.before[self.fed]) + leading

    def frames(self) -> Iterator[tuple[int, VideoFrame]]:
        """Yield (frame number, frame) in display order, from the key frame to the end of the file."""
        due: list[int] = []  # display times of the frames fed, from the key frame on
        for packet in self._all():
            if packet is not None:
                self.fed += packet is not self._ahead[0]
                # After damage, a demuxer may silently skip packets.
                if self.fed >= len(self._packets.places) or not self._packets.is_at(self.fed, packet):
                    self._note("its packet table and its packets disagree", _shown(packet))
                if _shown(packet) >= self._shown and not packet.is_discard:
                    insort(due, _shown(packet))
            for frame in self._decoded(packet):
                if frame.pts is not None and frame.pts >= self._shown:
                    # Numbered by the packets, so that a frame dropped by the decoder does not shift the others.
                    yield self.first + bisect_left(due, frame.pts), frame

    def _all(self) -> Iterator[Packet | None]:
        yield from self._ahead
        try:
            yield from self._demuxed
        except FFmpegError as error:
            self._note(_reason(error), sys.maxsize)
        yield None  # flush the decoder

    def _decoded(self, packet: Packet | None) -> Iterator[VideoFrame]:
        try:
            found = self._context.decode(packet)
        except FFmpegError as error:
            self._note(_reason(error), _shown(packet) if packet else sys.maxsize)
            return
        for frame in found:
            if frame.is_corrupt:
                self._note("the decoder calls it corrupt", frame.pts or 0)
            elif frame.key_frame and frame.pts is not None and frame.pts > self._hurt:
                self.trouble = ""
            yield frame

    def _note(self, why: str, time: int) -> None:
        self.trouble, self._hurt = why, time


def _shown(packet: Packet) -> int:
    if (time := packet.dts if packet.pts is None else packet.pts) is None:
        raise ValueError("its frames carry no times: convert it, e.g. with ffmpeg -i IN -c:v copy OUT.mp4")
    return time


@contextlib.contextmanager
def _opened(path: str | Path) -> Iterator[tuple[InputContainer, VideoStream]]:
    if Path(path).exists() and not Path(path).is_file():
        raise ValueError(f"{path} is no file: a pipe would be waited for for ever")
    try:
        with av.open(str(path), options={"format_whitelist": FORMATS}) as container:
            if not container.streams.video or not container.streams.video[0].codec_context:  # None: no such codec
                raise ValueError(f"{path} holds no video that can be decoded: give another file")
            stream = container.streams.video[0]
            stream.codec_context.thread_count = 1  # packing has a process per core
            # Report damage instead of concealing it.
            stream.codec_context.options = {"err_detect": "explode+crccheck+bitstream+buffer"}
            yield container, stream
    except FFmpegError as error:
        if isinstance(error, OSError) and not isinstance(error, ValueError):
            raise OSError(error.errno, error.strerror, str(path)) from None
        raise ValueError(f"{path} cannot be read as a video ({_reason(error)}): it is damaged or cut off") from None


def _reason(error: FFmpegError) -> str:
    return error.strerror or brief(error)


def _packets(path: str | Path) -> Packets:
    status = os.stat(path)
    return _read_packets(str(path), status.st_size, status.st_mtime_ns)


@functools.lru_cache(maxsize=8)
def _read_packets(path: str, size: int, changed: int) -> Packets:
    """Read the packet table. Mp4 and complete AVI files store one; in other files, all packets are visited."""
    with _opened(path) as (container, stream):
        avi, table = "avi" in container.format.name, getattr(stream, "index_entries", None)  # PyAV 15 has no table
        if table is not None and ("mp4" in container.format.name or (avi and len(table) == stream.frames)):
            found = [(e.timestamp, e.pos, e.is_keyframe, e.is_discard, None) for e in table if e.size]
        else:
            found = [(p.dts, p.pos, p.is_keyframe, p.is_discard, p.pts) for p in container.demux(stream) if p.size]
        unit = float(stream.time_base or 0)
        told = re.fullmatch(r"(\d+):(\d+):([\d.]+)", stream.metadata.get("DURATION", ""))  # of a Matroska file
        if table is None and avi and len(found) != stream.frames:
            raise ValueError(f"{path} is damaged, and PyAV {av.__version__} cannot number its frames: use 18 or newer")
    # The first packets of a Matroska file with B-frames have no decoding time: they get one before the first known.
    times = [row[0] for row in found]
    late = next((i for i, dts in enumerate(times) if dts is not None), 0)
    times[:late] = [(times[late] or 0) - late + i for i in range(late)]
    before = np.cumsum([0, *(not cut for *_, cut, _ in found)])
    if not before[-1] or None in times or any(place is None for _, place, *_ in found):
        raise ValueError(f"{path} holds no frames that can be told apart: it is damaged, or convert it to mp4")
    dts, places = np.array(times, np.int64), np.array([row[1] for row in found], np.int64)
    keys = np.flatnonzero([key for _, _, key, *_ in found])
    if (np.diff(dts) <= 0).any() and before[-1] < len(dts):
        raise ValueError(f"{path} is put together from pieces by an edit list: encode it again, ffmpeg -i IN OUT.mp4")
    if (np.diff(dts) <= 0).any() or not len(keys):
        raise ValueError(f"{path} has frames out of order or no key frame: it is damaged, or convert it to mp4")
    if told and dts[-1] * unit < 3600 * int(told[1]) + 60 * int(told[2]) + float(told[3]) - 1:
        raise ValueError(f"{path} ends after {dts[-1] * unit:.1f} s of {told[0]}: it is cut off, fetch it again")
    # What a cut took is shown after dts[-1], maybe before frames that are left, whose numbers would be too low.
    shown = np.sort([pts for *_, pts in found if pts is not None])
    steps = np.diff(shown)
    gaps = np.flatnonzero(steps > 1.5 * np.median(steps)) if len(steps) else steps
    if len(gaps) and shown[gaps[0] + 1] > dts[-1]:  # else its rate varies anyway
        end = f"{(shown[gaps[0]] - shown[0] + np.median(steps) / 2) * unit:.3f}"  # as -t counts
        how = f"fetch it again, or ffmpeg -i IN -t {end} OUT.mp4"
        raise ValueError(f"{path} lacks frames after its first {end} s: it is cut off, {how}")
    return Packets(dts, places, keys, before)
