"""Sources of live frames: cameras, video files, folders of pictures, and a simulated sensor.

Clocks, threads and faults are in ``live/streams.py``. Frames are uint8 RGB [H, W, 3].
"""

import glob
import importlib.util
import re
from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mvitac.data.images import IMAGES, decode
from mvitac.data.stamps import in_order, stamped
from mvitac.data.video import VIDEOS, frames
from mvitac.sim.sensors import SENSORS
from mvitac.system.files import brief

TOGETHER = 0.5  # seconds by which frames of several recordings may be apart


class Ended(Exception):
    """A source has no more frames."""


class Source(ABC):
    """A source of frames. ``read`` raises OSError if the device is gone, ValueError for one damaged frame."""

    captured: float | None = None  # when the newest frame was, by the stream's clock; None: when it was read
    crop: tuple[int, ...] = ()  # left, top, width and height of the part that is used
    sensor: str = ""  # name of the touch sensor, as in column sensor of packs; "" = not known

    @abstractmethod
    def open(self) -> None: ...

    @abstractmethod
    def read(self) -> np.ndarray: ...

    def wait(self, elapsed: float) -> float:
        """Seconds until the next ``read``, ``elapsed`` after the start; 0 for a device that waits itself."""
        return 0.0

    def close(self) -> None:  # noqa: B027 - most have nothing to close
        pass

    def cropped(self, image: np.ndarray) -> np.ndarray:
        """The part of [H, W, 3] that is used."""
        if not self.crop:
            return image
        left, top, width, height = self.crop
        part = image[top : top + height, left : left + width]
        if part.shape[:2] != (height, width):
            raise ValueError(f"crop {':'.join(map(str, self.crop))} reaches beyond {image.shape[1]} x {image.shape[0]}")
        return part


class Camera(Source):
    """A UVC camera by index, device path or USB serial number; DIGIT and GelSight Mini are such cameras."""

    def __init__(self, which: str, size: tuple[int, int] | None = None, fps: float | None = None) -> None:
        """``size`` (width, height) and ``fps`` to request from the camera; None keeps its own."""
        self.which, self.size, self.asked = which, size, fps

    def open(self) -> None:
        import cv2

        target: int | str = int(self.which) if self.which.isdigit() else self.which
        if isinstance(target, str) and not target.startswith("/"):
            if not (links := sorted(Path("/dev/v4l/by-id").glob(f"*{glob.escape(target)}*-index0"))):
                raise OSError(f"no camera with serial {target} is plugged in")
            target = str(links[0].resolve())
        self.capture = cv2.VideoCapture(target)
        self.capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)  # an old frame in a queue delays the newest
        if not self.capture.isOpened():
            raise OSError(f"camera {self.which} cannot be opened")
        width, height = self.size or (0, 0)
        asked = {cv2.CAP_PROP_FRAME_WIDTH: width, cv2.CAP_PROP_FRAME_HEIGHT: height, cv2.CAP_PROP_FPS: self.asked}
        for name, value in asked.items():
            if value:
                self.capture.set(name, value)
        given = [self.capture.get(name) for name in asked]
        # A driver may choose another mode without an error; some report no rate.
        if any(v and has and abs(has - v) > 0.05 * v for has, v in zip(given, asked.values(), strict=True)):
            mode = f"{given[0]:g}x{given[1]:g} at {given[2]:g} fps"
            raise OSError(f"camera {self.which} has no such mode: it gives {mode}")

    def read(self) -> np.ndarray:
        good, image = self.capture.read()
        if not good:
            raise OSError(f"camera {self.which} gives no frames")
        return np.ascontiguousarray(image[..., ::-1])  # OpenCV's frames are BGR

    def close(self) -> None:
        if hasattr(self, "capture"):
            self.capture.release()


class Recording(Source):
    """A recording: a source that ends, and knows the time of each of its frames."""

    path: Path
    times: np.ndarray  # [N] seconds, from ``open``
    begin: float | None = None  # the time at which it starts (``start_together``); None: that of its first frame
    number = -1  # of the frame that was read last, or was damaged

    @property
    def time(self) -> float:
        """Time of the frame that was read last."""
        return float(self.times[max(0, self.number)])

    def wait(self, elapsed: float) -> float:
        after = [*self.times[self.number + 1 :][:1], self.time + 0.1][0]  # 0.1: the last frame is used before the end
        return float(after - (self.times[0] if self.begin is None else self.begin)) - elapsed

    def read(self) -> np.ndarray:
        if self.number + 1 >= len(self.times):
            raise Ended
        self.number += 1
        return self.image(self.number)

    @abstractmethod
    def image(self, number: int) -> np.ndarray:
        """Frame ``number``; they are asked for in order."""


def start_together(files: Sequence[Recording]) -> None:
    """Let ``files`` start at one time, by their stamps; ValueError if two of them share none."""
    late, early = max(files, key=lambda file: file.times[0]), min(files, key=lambda file: file.times[-1])
    if late.times[0] > early.times[-1] + TOGETHER:
        ends = f"{early.path} ends at {early.times[-1]:.2f} s, {late.path} begins at {late.times[0]:.2f} s"
        raise ValueError(f"{ends}: give recordings of the same time, or FOLDER@FPS to pass over names that are times")
    begin = min(float(file.times[0]) for file in files)
    for file in files:
        file.begin = begin


class Video(Recording):
    """A video file, at its own frame rate."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def open(self) -> None:
        if self.number < 0:
            from mvitac.datasets.table.clocks import times_of  # robots that read no video have no pyarrow

            self.times = times_of(self.path)
        self.number, self.lost = -1, {}
        self.left = frames(self.path, range(len(self.times)), lost=self.lost)
        self.next = next(self.left, None)

    def image(self, number: int) -> np.ndarray:
        if self.next is None or self.next[0] > number:
            raise ValueError(self.lost.get(number, "it cannot be decoded"))
        (_, image), self.next = self.next, next(self.left, None)
        return image


class Folder(Recording):
    """The pictures of a folder, in the order in which ``mvitac data pack`` reads them, and without ``fps`` at its times."""

    def __init__(self, path: Path, fps: float | None = None) -> None:
        self.path, self.rate = path, fps

    def open(self) -> None:
        files = sorted(p for p in self.path.iterdir() if p.suffix.lower() in IMAGES)
        place = {name: number for number, name in enumerate(in_order({file.stem for file in files}))}
        self.files = sorted(files, key=lambda file: place[file.stem])
        if not self.files:
            raise OSError(f"{self.path} holds no pictures ({', '.join(IMAGES)})")
        times = None if self.rate else stamped([file.stem for file in self.files])
        self.times = np.arange(len(self.files)) / (self.rate or 30.0) if times is None else times
        self.number = -1

    def image(self, number: int) -> np.ndarray:
        return np.array(decode(self.files[number], self.files[number].name))


class Simulated(Source):
    """A simulated sensor: one second without contact, two seconds of touching a new material, repeated.

    Camera and gel of one seed show the same touch. The first rest is longer: live input learns the free gel then, on a
    slow machine for more than a second.
    """

    first, rest, hold = 3.0, 1.0, 2.0

    def __init__(self, modality: str, seed: int = 0, fps: float = 30.0, size: int = 72) -> None:
        self.modality, self.seed, self.fps, self.size = modality, seed, fps, size
        self.sensor = min(name for name, sensor in SENSORS.items() if not sensor.held_out)

    def open(self) -> None:
        self.number, self.touch = 0, -1
        self.noise = np.random.default_rng([self.seed, self.modality == "touch"])

    def wait(self, elapsed: float) -> float:
        return 1 / self.fps - elapsed % (1 / self.fps)

    def read(self) -> np.ndarray:
        from mvitac.sim import gel, materials

        touch, phase = divmod(max(0.0, self.number / self.fps - self.first + self.rest), self.rest + self.hold)
        if int(touch) != self.touch:
            self.touch = int(touch)
            rng = np.random.default_rng([self.seed, self.touch])
            address = int(rng.integers(len(materials.CLASSES))), int(rng.integers(60)), int(rng.integers(5))
            sensor = SENSORS[self.sensor]  # one for all touches, as on a robot
            pair = materials.touch(self.seed, *address, size=self.size, sensors=(sensor,))
            quiet = np.zeros((self.size, self.size), np.float32)
            blank = gel.render(quiet, sensor, rng, pixel_mm=12.8 / self.size, unit=1)
            self.pictures = {"vision": (pair["vision"],) * 2, "touch": (blank, pair["touch"])}
        self.number += 1
        image = self.pictures[self.modality][phase >= self.rest].astype(np.float32)
        image += self.noise.normal(0, 1.0, image.shape[:2])[..., None]
        return np.clip(image + 0.5, 0, 255).astype(np.uint8)


MODE = re.compile(r"(?P<which>.+?)(@(?P<width>\d+)x(?P<height>\d+))?(@(?P<fps>\d+(\.\d+)?))?")


def crop_of(text: str) -> tuple[str, tuple[int, ...]]:
    """A source's text without ``#x:y:width:height`` at its end, and these numbers; () = all of its images."""
    found = re.fullmatch(r"(.*)#(\d+):(\d+):([1-9]\d*):([1-9]\d*)", text)
    if not found and not Path(text).exists() and re.search(r"#[^/]*:[^/]*$", text):
        raise ValueError(f"source {text!r}: give the part as #x:y:width:height, in pixels")
    return (found[1], tuple(map(int, found.groups()[1:]))) if found else (text, ())


def source(text: str, modality: str) -> Source:
    """The source that ``text`` names; ValueError if there is none, or its file cannot be read.

    A camera (``0``, ``/dev/video2``, ``serial:D20345``; ``@320x240@60`` after it requests that mode), a video file, a
    folder[@fps], or ``sim``[:seed] of this modality; ``#x:y:width:height`` at the end crops its images.
    """
    text, crop = crop_of(text)
    mode = MODE.fullmatch(text)
    if text.partition(":")[0] == "sim":
        if not (seed := text.removeprefix("sim").removeprefix(":") or "0").isdecimal():
            raise ValueError(f"source {text!r}: {seed!r} is no seed, a whole number from 0")
        found: Source = Simulated(modality, int(seed))
    elif mode and (mode["which"].isdigit() or text.startswith(("/dev/", "serial:"))):
        if importlib.util.find_spec("cv2") is None:
            raise ValueError(f"source {text!r} needs OpenCV: pip install -e '.[live]' in mvitac's clone")
        if mode["which"] == "serial:":
            raise ValueError(f"source {text!r}: give the camera's serial number after serial:")
        size = (int(mode["width"]), int(mode["height"])) if mode["width"] else None
        found = Camera(mode["which"].removeprefix("serial:"), size, float(mode["fps"]) if mode["fps"] else None)
    else:
        found = recording(text)
    found.crop = crop
    return found


def _place(text: str) -> tuple[Path, float | None]:
    name, _, rate = text.rpartition("@")
    if not (name and Path(name).is_dir()):
        return Path(text), None
    if not re.fullmatch(r"\d*\.?\d+", rate) or not float(rate):
        raise ValueError(f"source {text!r}: {rate!r} is no frame rate")
    return Path(name), float(rate)


def is_recording(text: str) -> bool:
    """Whether ``text`` names a video, or a folder[@fps] with images or nothing in it."""
    path, _ = _place(crop_of(text)[0])
    files = [*path.iterdir()] if path.is_dir() else [path]
    pictures = path.is_dir() and any(file.suffix.lower() in IMAGES for file in files)
    return not files or pictures or path.suffix.lower() in VIDEOS


def recording(text: str) -> Recording:
    """The video file or the folder[@fps] that ``text`` names; ValueError if there is none, or it cannot be read."""
    text, crop = crop_of(text)
    path, fps = _place(text)
    if not (path.is_dir() or path.suffix.lower() in VIDEOS):
        known = f"a video ({', '.join(VIDEOS)}) or a folder[@fps]"
        raise ValueError(f"source {text!r}: give {known}; mvitac live also takes a camera or sim")
    files = Folder(path, fps) if path.is_dir() else Video(path)
    files.crop = crop
    try:  # now: unlike a camera, a missing file does not come back
        files.open()
    except (OSError, ValueError) as error:
        raise ValueError(f"source {text!r}: {brief(error)}") from None
    return files
