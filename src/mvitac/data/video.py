"""Listed frames of a video file, each decoded once, in one forward pass.

Frame i is the i-th in display order, from 0: what seeking a player to frame i shows. Its place is taken from the
container's own table of packets, never from a time multiplied by a nominal rate; the decoder starts at the last key frame
before a stretch of wanted frames and skips what lies between stretches, so that a few touches in an hour of video cost
their own frames and not the hour. Memory is bounded by the decoder's. No torch here: packing workers import it.
"""

from __future__ import annotations

import contextlib
import functools
import os
import sys
from bisect import bisect_left, insort
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import av
import numpy as np
from av.container import InputContainer
from av.error import FFmpegError
from av.packet import Packet
from av.video.frame import VideoFrame
from av.video.reformatter import Interpolation, VideoReformatter
from av.video.stream import VideoStream

from mvitac.system.files import brief


@dataclass(frozen=True)
class Packets:
    """The packets that the decoder needs, in the order in which they are stored and decoded.

    Those that an edit list cuts off (a trim without re-encoding) are decoded, since others refer to them, but not shown:
    they are no frames.
    """

    dts: np.ndarray
    """[P] int64 decoding times."""
    places: np.ndarray
    """[P] int64 where they are in the file."""
    keys: np.ndarray
    """[K] int64 ascending numbers of the packets at which decoding can start."""
    before: np.ndarray
    """[P + 1] int64 how many frames are stored before each packet, and in all."""
    shape: tuple[int, int]
    """Height and width of the frames, as the container says."""

    @property
    def num(self) -> int:
        """How many frames are shown."""
        return int(self.before[-1])

    def start_of(self, frame: int) -> int:
        """Number in ``keys`` of the last key packet before which no more than ``frame`` frames are stored."""
        return max(0, int(np.searchsorted(self.before[self.keys], frame, side="right")) - 1)


def num_frames(path: str | Path) -> int:
    """How many frames the file promises; ValueError or OSError if it is no whole video."""
    return _packets(path).num


def frame_shape(path: str | Path) -> tuple[int, int]:
    """Height and width of the frames, as the file promises; ValueError or OSError if it is no whole video."""
    return _packets(path).shape


def frames(
    path: str | Path, wanted: Iterable[int], size: int | None = None, *, lost: dict[int, str] | None = None
) -> Iterator[tuple[int, np.ndarray]]:
    """The ``wanted`` frames in ascending order, as (i, uint8 RGB [H, W, 3]), squashed to [size, size, 3] if given.

    A frame that the file does not hold or that is damaged raises ValueError; with ``lost`` it is left out and its reason
    is put there instead. OSError if the file cannot be read at all.
    """
    pending = sorted({int(i) for i in wanted}, reverse=True)  # the next one is the last
    if pending and pending[-1] < 0:
        raise ValueError(f"{path}: frame {pending[-1]} is wanted: frames are counted from 0")
    packets = _packets(path)

    def lose(why: str = "is beyond the end of what can be read: the file is cut off, fetch it again") -> None:
        frame = pending.pop()
        if frame >= packets.num:
            why = f"is wanted, the video ends after frame {packets.num - 1}: is it the right one, and whole?"
        if lost is None:
            raise ValueError(f"{path}: frame {frame} {why}")
        lost[frame] = why

    with _opened(path) as (container, stream):
        shrink = VideoReformatter()  # keeps its tables from frame to frame
        key = 0
        while pending:
            if pending[-1] >= packets.num:
                lose()
                continue
            key = max(key, packets.start_of(pending[-1]))
            run = _Run(container, stream, packets, key)
            if run.first > pending[-1] and key:  # the key frame is shown after the frame that it was to lead to
                run = _Run(container, stream, packets, key - 1)
            for number, frame in run.frames():
                while pending and pending[-1] < number:
                    lose(f"cannot be decoded ({run.trouble or 'nothing came out'}): fetch the video again")
                if pending and pending[-1] == number:
                    if run.trouble:
                        lose(f"cannot be decoded ({run.trouble}): fetch the video again")
                    else:
                        pending.pop()
                        yield number, _rgb(shrink, frame, size)
                if not pending:
                    break
                ahead = packets.start_of(pending[-1])
                if ahead > key and packets.keys[ahead] > run.fed + 1:  # nearer to what is wanted next
                    break
            else:
                while pending:
                    lose()


def _rgb(shrink: VideoReformatter, frame: VideoFrame, size: int | None) -> np.ndarray:
    """Bilinear, as Pillow does it when shrinking (every source pixel counts), but straight from the decoder's planes."""
    made = shrink.reformat(
        frame,
        width=size or frame.width,
        height=size or frame.height,
        format="rgb24",
        interpolation=Interpolation.BILINEAR,
    )
    return made.to_ndarray()


class _Run:
    """One start of the decoder, at key packet number ``key`` of ``packets``; ``frames`` numbers what comes out."""

    def __init__(self, container: InputContainer, stream: VideoStream, packets: Packets, key: int) -> None:
        self._context, self._packets = stream.codec_context, packets
        self._context.flush_buffers()
        self.fed = int(packets.keys[key])
        """Number of the packet handed to the decoder last."""
        self.trouble = ""
        """What is wrong with the stream from here to the next key frame, if anything."""
        self._hurt = 0  # when the damaged frame is displayed
        self._demuxed = _from(container, stream, int(packets.dts[self.fed]))
        # Pictures shown before a key frame may be stored after it, but before all others: they refer to what came before
        # the key frame and belong to the start before this one. How many there are says which frame the key frame is.
        self._ahead: list[Packet] = []
        for packet in self._demuxed:
            self._ahead.append(packet)
            if _shown(packet) > _shown(self._ahead[0]):
                break
        self._shown = _shown(self._ahead[0]) if self._ahead else 0
        leading = sum(_shown(p) < self._shown and not p.is_discard for p in self._ahead)
        self.first = int(packets.before[self.fed]) + leading
        """Which frame the key frame is, or if it is cut off the first one after it."""

    def frames(self) -> Iterator[tuple[int, VideoFrame]]:
        """(frame number, frame) in display order, from the key frame to the end of the file."""
        due: list[int] = []  # times of the frames fed, from the key frame on, in display order
        for packet in self._all():
            if packet is not None:
                self.fed += packet is not self._ahead[0]
                if not self._is_next(packet):
                    self._note("the table of its frames and what is there disagree", _shown(packet))
                if _shown(packet) >= self._shown and not packet.is_discard:
                    insort(due, _shown(packet))
            for frame in self._decoded(packet):
                if frame.pts is not None and frame.pts >= self._shown:
                    # Counted among the packets, so that a frame the decoder drops shifts no other.
                    yield self.first + bisect_left(due, frame.pts), frame

    def _is_next(self, packet: Packet) -> bool:
        """Whether ``packet`` is the one that ``fed`` counts: after damage a demuxer may resume at a later one, unsaid."""
        if self.fed >= len(self._packets.places) or packet.pos is None:
            return False
        return packet.pos - int(self._packets.places[self.fed]) in (
            0,
            8,
        )  # with or without the header of an AVI's chunk

    def _all(self) -> Iterator[Packet | None]:
        yield from self._ahead
        try:
            yield from self._demuxed
        except FFmpegError as error:
            self._note(_reason(error), sys.maxsize)
        yield None  # what the decoder still holds

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
    """When a packet's frame is displayed, in the stream's own time units."""
    time = packet.pts if packet.pts is not None else packet.dts
    if time is None:
        raise ValueError("its frames carry no times: convert it, e.g. with ffmpeg -i IN -c:v copy OUT.mp4")
    return time


def _from(container: InputContainer, stream: VideoStream, dts: int) -> Iterator[Packet]:
    """The packets from the one with time ``dts`` on."""
    container.seek(dts, stream=stream, backward=True)
    found = False
    for packet in container.demux(stream):
        found = found or packet.dts == dts
        if found and packet.size:
            yield packet


@contextlib.contextmanager
def _opened(path: str | Path) -> Iterator[tuple[InputContainer, VideoStream]]:
    """The file and its video stream; errors name the file and say what to do."""
    try:
        with av.open(str(path)) as container:
            if not container.streams.video:
                raise ValueError(f"{path} holds no video: give another file")
            stream = container.streams.video[0]
            stream.codec_context.thread_count = 1  # packing has a process per core
            # Damage must be noticed, not painted over.
            stream.codec_context.options = {"err_detect": "explode+crccheck+bitstream+buffer"}
            yield container, stream
    except FFmpegError as error:
        if isinstance(error, OSError) and not isinstance(error, ValueError):
            raise OSError(error.errno, error.strerror, str(path)) from None
        raise ValueError(
            f"{path} cannot be read as a video ({_reason(error)}): it is damaged or cut off, fetch it again"
        ) from None


def _reason(error: FFmpegError) -> str:
    return error.strerror or brief(error)


def _packets(path: str | Path) -> Packets:
    status = os.stat(path)
    return _read_packets(str(path), status.st_size, status.st_mtime_ns)


@functools.lru_cache(maxsize=8)
def _read_packets(path: str, size: int, changed: int) -> Packets:
    """The packet table: mp4 and a whole AVI carry one; of other files every packet is visited, none decoded."""
    with _opened(path) as (container, stream):
        shape = (stream.codec_context.height, stream.codec_context.width)
        table = stream.index_entries
        if "mp4" in container.format.name or ("avi" in container.format.name and len(table) == stream.frames):
            found = [(e.timestamp, e.pos, e.is_keyframe, e.is_discard) for e in table if e.size]
        else:
            found = [(p.dts, p.pos, p.is_keyframe, p.is_discard) for p in container.demux(stream) if p.size]
    before = np.cumsum([0, *(not cut for *_, cut in found)])
    if not before[-1] or any(dts is None or place is None for dts, place, *_ in found):
        raise ValueError(f"{path} holds no frames that can be told apart: it is damaged, or convert it to mp4")
    dts, places = (np.array([row[i] for row in found], np.int64) for i in (0, 1))
    keys = np.flatnonzero([key for _, _, key, _ in found])
    if (np.diff(dts) <= 0).any() and before[-1] < len(dts):
        raise ValueError(f"{path} is put together from pieces by an edit list: encode it anew, ffmpeg -i IN OUT.mp4")
    if (np.diff(dts) <= 0).any() or not len(keys):
        raise ValueError(f"{path} has frames out of order or no key frame: it is damaged, or convert it to mp4")
    return Packets(dts, places, keys, before, shape)
