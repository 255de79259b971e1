"""Live prediction in real time with a fault about every 14 seconds: sensors vanish, frames drop, clocks jump, disks fill.

    python -m benchmarks.live_faults --minutes 60 --disk FOLDER

Two simulated sensors are read by their threads at 15 frames a second. Each fault lasts some three seconds and must be
told by its name, and nothing else; then predictions must come again. While the disk is full, recording must stop and
prediction go on; with space again the recording must hold every pair that was kept. FOLDER is a small file system of its
own (a few MB, e.g. a tmpfs), which is filled for this. The result is printed as JSON; the exit code is 1 if anything was
not as it must be.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import json
import shutil
import sys
import tempfile
import threading
import time
from collections import Counter
from itertools import cycle, product
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.faults import child, prepare
from mvitac.cli.main import main as mvitac
from mvitac.data.pack import Pack
from mvitac.deploy.engine import Engine, frame_shapes
from mvitac.live.cameras import Simulated
from mvitac.live.contact import LiveConfig
from mvitac.live.predictor import Live
from mvitac.live.recorder import Recorder, finish
from mvitac.live.streams import CaptureThread, Event, Stream
from mvitac.sim import materials

FPS = 15.0
STALE = 5.0
"""Seconds; more than usual, as a busy machine may really give no frames for some."""
TOLD = {
    "vanished": ("unplugged", "back"),
    "frozen": ("frozen", "moving again"),
    "stalled": ("stalled", "running again"),
    "resolution": ("resolution changed",),
    "damaged": ("damaged frame",),  # every second one
    "dropped": (),
    "clock forward": ("stalled", "running again"),
    "disk full": (),
}
"""What must be said of each fault. Where frames drop for less than ``STALE`` seconds, nothing."""
CALM = ("calibrated", "uneasy calibration")
"""May follow every fault."""


class Clock:
    """The time since the machine started, which can be made to jump."""

    jumped = 0.0

    def __call__(self) -> float:
        return time.monotonic() + self.jumped


class Faulty(Simulated):
    """A simulated sensor that breaks as ``fault`` says."""

    fault = ""

    def open(self) -> None:
        if self.fault == "vanished":
            raise OSError("no such device")
        super().open()

    def read(self) -> np.ndarray:
        if self.fault == "vanished":
            raise OSError("no frames")
        while self.fault == "stalled":
            time.sleep(0.02)
        if self.fault == "damaged" and self.noise.random() < 0.5:
            raise ValueError("corrupt JPEG data")
        if self.fault == "dropped":
            time.sleep(0.3)
        if self.fault != "frozen":
            self.shown = super().read()
        return self.shown[::2, ::2] if self.fault == "resolution" else self.shown


class Rig:
    """``Live`` with one faulty sensor per modality."""

    def __init__(self, engine: Engine) -> None:
        self.clock, self.engine, self.heard = Clock(), engine, list[Event]()
        self.sources = {m: Faulty(m, fps=FPS, size=32) for m in frame_shapes(engine)}
        self.streams = {m: Stream(m, s, clock=self.clock, stale_after=STALE) for m, s in self.sources.items()}
        config = LiveConfig(calibration=6)  # a rest has 15 frames
        each = {m: [stream] for m, stream in self.streams.items()}
        self.live = Live(engine, each, config, clock=self.clock, tell=self.heard.append)
        self.news = threading.Event()
        self.threads = [CaptureThread(stream, self.news.set) for stream in self.streams.values()]
        for thread in self.threads:
            thread.start()

    def run(self, seconds: float) -> int:
        """Predict for so long; returns the number of predictions."""
        before, end = self.live.num_predictions, time.monotonic() + seconds
        while time.monotonic() < end:
            self.news.wait(0.05)
            self.news.clear()
            self.live.tick()
        return self.live.num_predictions - before


def fill(disk: Path) -> Path:
    """Write until the file system of ``disk`` is full."""
    filler = disk / "filler"
    with contextlib.suppress(OSError), filler.open("wb", buffering=0) as file:
        while True:
            file.write(bytes(4096))
    return filler


def record_on_a_full_disk(rig: Rig, disk: Path, *, also_at_the_end: bool) -> str:
    """Fill ``disk`` while recording; says what is wrong."""
    out, said = disk / "recording", list[str]()
    rig.live.record = recorder = Recorder(out, fps=30.0, tell=said.append)
    for _ in range(20):
        if not recorder.num:
            rig.run(3)
    filler = fill(disk)
    kept, num = recorder.num, sum(0 if recorder.failed else rig.run(3) for _ in range(20)) + rig.run(3)
    events = {e.what for e in rig.heard} - set(CALM)
    if not recorder.failed or len(said) != 1 or not num or not kept or events:
        return f"recorded {kept}, then {num} predictions, {said} and {events}"
    del rig.heard[:]  # frames may wait while a recording is made
    if also_at_the_end:
        with contextlib.suppress(OSError):
            return f"closed with {recorder.close()} pairs on a full disk"
        filler.unlink()
        found = finish(out)
    else:
        filler.unlink()
        found, kept = recorder.close(), kept + len(recorder.waiting)
    good = found == Pack(out, verify=True).num >= kept
    shutil.rmtree(out)
    return "" if good and not list(disk.iterdir()) else f"{found} pairs of {kept}, left {list(disk.iterdir())}"


def cause(rig: Rig, fault: str, modality: str, disk: Path) -> tuple[str, str]:
    """Cause one fault and end it; returns what is wrong, and what was said of the other stream."""
    del rig.heard[:]
    wrong = ""
    if fault == "disk full":
        wrong = record_on_a_full_disk(rig, disk, also_at_the_end=modality == "touch")
        rig.live.record = None
        for left in disk.iterdir():
            shutil.rmtree(left) if left.is_dir() else left.unlink()
        rig.run(1)
        del rig.heard[:]
    elif fault == "clock forward":
        rig.clock.jumped += 30
        rig.run(3)
    else:
        rig.sources[modality].fault = fault
        during = rig.run(STALE + 2 if fault == "stalled" else 3)
        rig.sources[modality].fault = ""
        if fault == "dropped" and not during:
            wrong = "no predictions while frames dropped"
    rig.run(2)
    if not rig.run(8):
        wrong = f"{wrong} no predictions afterwards".strip()
    both = fault == "clock forward"
    said = {e.what for e in rig.heard if both or e.stream == modality} - set(CALM)
    if not said <= set(TOLD[fault]) or not (both or said == set(TOLD[fault])):  # a jump may be over before it is seen
        wrong = f"{wrong} said {sorted(said)}".strip()
    others = "" if both else ", ".join(sorted({e.what for e in rig.heard if e.stream != modality} - set(CALM)))
    return wrong, others


def resident() -> float:
    """Megabytes of this process in memory."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 1e6


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=60)
    parser.add_argument("--disk", type=Path, required=True, help="an empty, small file system that may be filled")
    options = parser.parse_args()
    if shutil.disk_usage(options.disk).total > 64 << 20:
        parser.error(f"--disk {options.disk}: more than 64 MB, filling it would take long")
    with tempfile.TemporaryDirectory(prefix="mvitac-live-") as folder:
        base = Path(folder)
        words = f"export {base}/run --rows 4 --out {base}/export".split()
        for work in (lambda: prepare(base), lambda: mvitac(words)):
            if child(work, base / "said"):
                raise RuntimeError((base / "said").read_text())
        materials.touch = functools.cache(materials.touch)  # on a busy machine, sensors that simulate really stall
        rig = Rig(Engine(base / "export", threads=1))
    rig.run(8)
    made, failed, others, memory = Counter[str](), [], Counter[str](), []
    start, end = time.monotonic(), time.monotonic() + 60 * options.minutes
    for fault, modality in cycle(product(TOLD, ("touch", "vision"))):
        if time.monotonic() > end:
            break
        wrong, other = cause(rig, fault, modality, options.disk)
        made[fault] += 1
        others.update([other] if other else [])
        if wrong:
            failed.append({"fault": fault, "stream": modality, "wrong": wrong})
            print(failed[-1], file=sys.stderr, flush=True)
        memory.append(resident())
    for thread in rig.threads:
        thread.stopping.set()
    found: dict[str, Any] = {"minutes": round((time.monotonic() - start) / 60, 1), "faults": dict(made)}
    found |= {"said of the other stream": dict(others), "failed": failed, "live": rig.live.summary()}
    found |= {"memory in MB": {"after 16 faults": memory[min(15, len(memory) - 1)], "at most": max(memory)}}
    print(json.dumps(found, indent=1))
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main())
