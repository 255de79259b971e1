"""Record live input: pairs are written to a temporary folder, the spool, and become a pack at the end.

After a crash the spool stays, and ``finish`` makes the pack.
"""

import io
import json
import shlex
import shutil
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from mvitac.data.build import build
from mvitac.data.source import Sample, Source
from mvitac.data.spec import DataSpec
from mvitac.system.files import brief, digest_file, write_atomic
from mvitac.system.locks import check_new, hold_lock

Tell = Callable[[str], object]
Crop = Mapping[str, str]  # as ``DataSpec.crop``
SPOOL = 64  # pairs per file of the spool: the number that a crash can lose


class Recorder:
    """Call it with every pair; at most ``fps`` per second are kept. A full disk ends it, and ``tell`` gets a sentence."""

    def __init__(self, out: Path, *, fps: float = 10, sensor: str = "", crop: Crop | None = None, tell: Tell = print):
        """Record into the new folder ``out``; ``sensor`` is the touch sensor's name, if it is known (column sensor)."""
        check_new(out)
        self.out, self.every, self.tell, self.failed = out, 1 / fps, tell, False
        self.named, self.crop = {"sensor": sensor} if sensor else {}, np.array(json.dumps(dict(crop or {})))
        self.spool = _spool(out)
        if self.spool.exists():
            still = "is of a recording that still runs, or crashed and is finished by"
            raise ValueError(f"{self.spool} {still} {_command(out)}")
        self.held = ExitStack()
        self.held.enter_context(hold_lock(out, f"{out} is being recorded", wait=False))
        self.spool.mkdir(parents=True)
        self.waiting: list[tuple[dict[str, np.ndarray], dict[str, Any]]] = []
        self.num, self._next = 0, float("-inf")
        self.shapes: dict[str, tuple[int, ...]] = {}

    def __call__(self, images: dict[str, np.ndarray], columns: dict[str, Any]) -> None:
        """Keep a pair (uint8 [S, S, C]) if it is due; ``columns`` has at least time, contact and touch_number."""
        time = columns["time"]
        if time < self._next or self.failed:
            return
        # From the last due time: from this pair, every delay would lower the rate. Missed pairs are not made up for later.
        self._next += self.every
        if time >= self._next:
            self._next = time + self.every
        shapes = {m: image.shape for m, image in images.items()}
        self.shapes = self.shapes or shapes
        if shapes != self.shapes:
            raise ValueError(f"images of {shapes} after {self.shapes}: record each size into a folder of its own")
        self.waiting.append(({m: np.array(image) for m, image in images.items()}, {**columns, **self.named}))
        if len(self.waiting) == SPOOL:
            self._flush()

    def _flush(self) -> None:
        if not self.waiting:
            return
        pairs, rows = zip(*self.waiting, strict=True)
        arrays = {m: np.stack([images[m] for images in pairs]) for m in pairs[0]}
        columns = {f"column_{name}": np.array([row[name] for row in rows]) for name in rows[0]}
        buffer = io.BytesIO()
        np.savez(buffer, crop=self.crop, **arrays, **columns)  # type: ignore[arg-type]
        try:
            self.spool.stat()  # if it was moved away, a new one would lack the parts before
            write_atomic(self.spool / f"{self.num:08d}.npz", lambda file: file.write(buffer.getvalue()))
        except OSError as error:
            if not self.failed:
                self.tell(f"recording stopped, prediction goes on: {error.filename}: {error.strerror}")
            self.failed = True
            return
        self.num += len(self.waiting)
        self.waiting = []

    def close(self) -> int:
        """Write the last pairs and make the pack; returns its number of pairs (0: none). ValueError: they stay."""
        self._flush()
        try:
            with self.held:
                return finish(self.out)
        except (OSError, ValueError) as error:
            there = f"{self.num} pairs are kept in {self.spool}, make room and finish them by"
            kept = there if self.spool.exists() else "put it back where it was, and finish it by"
            raise ValueError(f"{brief(error)}: {kept} {_command(self.out)}") from None


def _command(out: Path) -> str:
    name = json.dumps(str(out), ensure_ascii=False)
    return "python -c " + shlex.quote(f'from mvitac.live.recorder import finish; print(finish({name}), "pairs")')


def _spool(out: Path) -> Path:
    return out.with_name(out.name + ".spool")


def finish(out: str | Path) -> int:
    """Make ``out`` from its spool, which is then deleted; returns its number of pairs (0: nothing is made).

    Busy if it is still being recorded; ValueError if other files are in the spool.
    """
    spool, num = Recorded(_spool(Path(out))), 0
    with hold_lock(Path(out), f"{out} is still being recorded: stop that first", wait=False):
        if others := {path for path in spool.path.iterdir() if path.suffix != ".tmp"} - {*spool.files}:
            raise ValueError(f"{min(others)} is of no recording: take it out of there")
        if spool.files:  # none after a crash before the first
            num = build(spool, Path(out), size=next(reversed(spool.shapes.values()))[0], quiet=True).num
        shutil.rmtree(spool.path)
    return num


class Recorded(Source):
    """A spool as the source of a pack; each of its files is an item."""

    def __init__(self, path: Path) -> None:
        self.path, self.files = path, sorted(path.glob("*.npz"))

    @cached_property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Of the images, [S, S, C], by modality."""
        with np.load(self.files[0], allow_pickle=False) as part:
            return {m: part[m].shape[1:] for m in ("vision", "touch") if m in part.files}

    def spec(self) -> DataSpec:
        channels: Any = {f"{m}_channels": self.shapes.get(m, (0,))[-1] for m in ("vision", "touch")}
        about: Any = {"name": "recording", "group_by": "phase", "source": "mvitac live", "tasks": ()}
        with np.load(self.files[0], allow_pickle=False) as part:
            about["crop"] = json.loads(part["crop"].item())
        return DataSpec(**about, **channels, licence="as the one who recorded it decides")

    def items(self) -> Sequence[str]:
        return [path.name for path in self.files]

    def samples_per_item(self) -> list[int]:
        return [SPOOL] * len(self.files)

    def fingerprint(self) -> dict[str, Any]:
        return {"recording": [digest_file(path) for path in self.files]}

    def read(self, item: int) -> list[Sample]:
        with np.load(self.files[item], allow_pickle=False) as part:
            arrays = {name: part[name] for name in part.files}
        first = int(self.files[item].stem)
        columns = {n.removeprefix("column_"): x.tolist() for n, x in arrays.items() if n.startswith("column_")}
        samples = []
        for i in range(len(columns["time"])):
            own: dict[str, Any] = {name: values[i] for name, values in columns.items()}
            # Frames of one touch are near-copies, so each touch is a group; so is each rest between touches.
            group = f"{'touch' if own['contact'] else 'rest'}-{own['touch_number']:06d}"
            own |= {"id": f"{first + i:08d}", "group": group, "touch_group": group, "split": "unlabelled"}
            vision, touch = (arrays[m][i] if m in arrays else None for m in ("vision", "touch"))
            samples.append(Sample(vision=vision, touch=touch, columns=own))
        return samples
