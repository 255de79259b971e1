"""``mvitac live`` and ``predict``: answers from the frames of cameras and sensors, and from recordings."""

import json
import math
import os
import signal
import sys
import threading
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pyarrow as pa
import tyro
from pyarrow.csv import CSVWriter
from tyro.conf import Positional

from mvitac.cli.options import check_json, check_models, loading, parse
from mvitac.data.images import decode
from mvitac.data.pack import Pack
from mvitac.datasets import dataset
from mvitac.datasets.pack import PackConfig
from mvitac.deploy.engine import EXPORT, Engine, about_sensor, frame_shapes
from mvitac.live.cameras import is_recording, recording, source
from mvitac.live.contact import LiveConfig
from mvitac.live.predictor import Live
from mvitac.live.recorder import Recorder
from mvitac.live.recordings import TOGETHER, Recordings, pack_tables
from mvitac.live.streams import CaptureThread, Stream
from mvitac.registry import check_range, to_json
from mvitac.system.files import cache_dir, digest, write_atomic, write_json
from mvitac.system.progress import shown, work


@dataclass(frozen=True, kw_only=True)
class _Common:
    model: Annotated[Positional[str], tyro.conf.arg(metavar="MODEL")]
    """Folder of an export (fastest); or of a run or an artifact, or owner/name on the Hub, which is exported first, if
    the data that it was trained on is here (else: mvitac export --on PACK)."""
    vision: str | None = None
    """SOURCE of the camera. Of other data than recordings: the name of its images."""
    touch: tuple[str, ...] = ()
    """SOURCE of the touch sensor, or of both of a gripper: left right. Of other data: the name of its images."""
    background: tuple[Path, ...] = ()
    """Image of the touch sensor without contact, one of each sensor, instead of the first frames."""
    threads: int = 0
    """CPU threads for the model; 0 = all cores."""
    live: Annotated[LiveConfig, tyro.conf.arg(name="")] = LiveConfig()

    def __post_init__(self) -> None:
        if "" in (self.vision, *self.touch):
            raise ValueError("--vision or --touch is empty: name a SOURCE, or leave it out")

    def free(self) -> list[np.ndarray]:
        if self.background and self.live.calibration != LiveConfig.calibration:
            raise ValueError("--calibration has no effect beside --background: leave one out")
        return [np.array(decode(file)) for file in self.background]


@dataclass(frozen=True, kw_only=True)
class _Options(_Common):
    """Predict from live frames: only the newest frame counts, old ones are never used. Every prediction is a line of JSON on
    stdout, with time in seconds, classes with confidence, and values with unit and spread; every fault is a line on
    stderr. Ctrl-C ends it with a summary.

    A SOURCE is a camera (its number, /dev/videoN or serial:NAME; @WIDTHxHEIGHT and @FPS after it ask for that mode, e.g.
    serial:D20345@320x240@60), a video file, a folder of pictures[@FPS], or sim[:SEED]. Without any, all are simulated.
    #x:y:width:height after it is the part that is used, where the data was packed with --crop.
    """

    sensor: str = ""
    """Name of the touch sensor, as in column sensor of the training data: live says if the model never met it."""
    record: Path | None = None
    """Record the frames as a pack in this new folder, at most ten pairs a second."""
    seconds: float | None = None
    """Stop after this many seconds."""
    stale: float = 0.5
    """Age in seconds from which a frame is too old to be used."""
    json: Path | None = None
    """Write the summary to this file."""
    always: bool = False
    """Predict from every frame, in contact or not."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range(self, 1e-3, math.inf, "stale", *(["seconds"] if self.seconds is not None else []))


def live(argv: list[str]) -> None:
    options = parse(_Options, argv, "live")
    check_json(options.json)
    free = options.free()
    given = {"vision": options.vision, "touch": options.touch}
    engine = _engine(options.model, options.threads, tuple(m for m, texts in given.items() if texts))
    wanted = sources(frame_shapes(engine), options.vision, options.touch)
    _say_uncropped(engine, wanted)
    streams: Any = {}
    for m, texts in wanted.items():  # not yet open; several of one modality are numbered from 1
        named = ((f"{m} {i}" if len(texts) > 1 else m, text) for i, text in enumerate(texts, 1))
        streams[m] = [Stream(name, source(text, m), stale_after=options.stale) for name, text in named]
    if not (options.vision or options.touch):
        _say("no --vision, no --touch: all sensors are simulated")
    sensor = options.sensor or next((stream.origin.sensor for stream in streams.get("touch", ())), "")
    _say_sensors(engine, (sensor,))
    more: Any = {"tell": lambda event: _say(event.text), "free": free, "always": options.always}
    loop, recorder = Live(engine, streams, options.live, **more), None
    if options.record:  # last, for a refusal must leave no spool
        cuts = ((m, [s.origin.crop for s in several if s.origin.crop]) for m, several in streams.items())
        crop = {m: ", ".join(":".join(map(str, cut)) for cut in parts) for m, parts in cuts if parts}
        loop.record = recorder = Recorder(options.record, sensor=sensor, crop=crop, tell=_say)
    failed = _run(loop, options.seconds)
    if loop.counts["calibrated"] < sum(contact.free is None for contact in loop.contacts.values()):
        _say(f"contact was never known: no {options.live.calibration} frames without it, and no --background")
    _say(f"summary: {json.dumps(loop.summary())}")
    try:
        num = recorder.close() if recorder else 0  # may fail (a full disk)
    finally:
        if options.json:
            write_json(options.json, loop.summary())
    if recorder:
        _say(f"recorded: {options.record}, {num} pairs" if num else "nothing was recorded")
    if failed:
        raise failed


def _run(loop: Live, seconds: float | None) -> OSError | None:
    """Print every prediction and release until all streams ended, ``seconds`` are over, Ctrl-C or SIGTERM.
    Every stream is read in a thread of its own. Return why stdout took no more, if so."""
    start, news, failed = loop.clock(), threading.Event(), None
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)  # as Ctrl-C: what was recorded becomes a pack
    threads = [CaptureThread(stream, news.set) for stream in loop.all]
    for thread in threads:
        thread.start()
    try:
        while loop.clock() - start < (seconds or float("inf")) and not all(s.ended for s in loop.all):
            news.wait(0.05)
            news.clear()
            if said := loop.step():
                line = json.dumps({"time": loop.clock() - start, **said})
                short = json.loads(line, parse_float=lambda text: float(f"{float(text):.6g}"))
                try:
                    print(json.dumps(short), flush=True)
                except OSError as error:  # whoever read it has enough, or its disk is full: what was recorded is kept
                    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
                    failed = OSError(error.errno, f"stdout: {error.strerror}")
                    break
    except KeyboardInterrupt:
        _say("stopped")
    finally:
        for thread in threads:
            thread.stopping.set()
        for thread in threads:
            thread.join(2.0)  # a device that hangs must not hang us
        signal.signal(signal.SIGTERM, before)
    loop.finish()
    return failed


@dataclass(frozen=True, kw_only=True)
class _PredictOptions(_Common):
    """Predict from every frame of a recording, as fast as the model computes, into a table: frame number, time, contact,
    classes with probabilities, values with spread (docs/live.md).

    A SOURCE is a video file, or a folder of images[@FPS]. Frames of several recordings are matched by time.
    #x:y:width:height after it is the part that is used, where the data was packed with --crop.
    """

    source: Annotated[Positional[str | None], tyro.conf.arg(metavar="SOURCE")] = None
    """SOURCE, where the model takes one input; or other data: a pack, a table, a bag, whatever --data reads."""
    out: Path
    """The table (.csv), a row for each frame."""


def predict(argv: list[str]) -> None:
    options = parse(_PredictOptions, argv, "predict")
    files = not options.source or is_recording(options.source)
    if files and bool(options.source) == bool(options.vision or options.touch):
        raise ValueError("give one SOURCE, or those of --vision and --touch")
    check_json(options.out, "--out")
    if options.out.suffix.lower() in (".parquet", ".jsonl", ".json", ".xlsx"):
        raise ValueError(f"--out {options.out}: the table is CSV, give a name that ends in .csv")
    given = {"vision": (options.vision,) if options.vision else (), "touch": options.touch}
    opened = {m: [recording(text) for text in texts] for m, texts in given.items() if texts and files}
    single = [recording(options.source)] if options.source and files else []
    config: Any = None if files else dataset(options.source or "")  # what cannot be read is refused before an export
    if config and (options.background or options.live != LiveConfig()):
        raise ValueError("--background, --calibration and --contact are for recordings: leave them out")
    for name in (m for m, texts in given.items() if texts and config and not hasattr(config, m)):
        raise ValueError(f"--{name} is for recordings and tables, {options.source} knows its images: leave it out")
    engine = _engine(options.model, options.threads, tuple(opened), most=1 if single else 2)
    if not (engine.classes or engine.values):
        raise ValueError(f"{options.model} has no probes of classes or values: export it on data that has labels")
    if config:
        pack = _opened(config, given, engine)
        for note in (note for note in pack.spec.notes if "left out" in note or "are not there" in note):
            _say(f"note: {note}")
        for m in [m for m in engine.inputs if pack.spec.crop.get(m) != engine.crop.get(m)]:
            have, wanted = (crop.get(m, "whole images") for crop in (pack.spec.crop, engine.crop))
            _say(f"mvitac: warning: {m} shows {have}, the model learned from {wanted}: pack it with --crop")
        _say_sensors(engine, pack.column("sensor") if "sensor" in pack.table.column_names else ("",))
        about = ("group", "split") if isinstance(config, PackConfig) else ()  # those of a new table mean nothing
        try:
            num = pack.num - _write(options.out, pack_tables(engine, pack, about), pack.num)
        except ValueError as error:  # nobody knows the cache's folder
            raise ValueError(str(error).replace(str(pack.path), options.source or "")) from None
        if num:
            _say(f"{num} of {pack.num} rows are left out: without an image that the model takes")
        return
    opened = dict.fromkeys(engine.inputs, single) if single else opened
    _say_sensors(engine, ("",))
    _say_uncropped(engine, dict.fromkeys(engine.inputs, (options.source,)) if single else given)
    recordings = Recordings(engine, opened, options.live, options.free())
    try:
        _write(options.out, recordings.tables(), recordings.num)
    finally:  # also where no frame is left
        for text, first in [*recordings.told.items()][:9]:
            _say(f"from frame {first}: {text}")
        if num := recordings.left_out:
            _say(f"{num} frames are left out: damaged, or without a frame of the other recording within {TOGETHER} s")
    if "touch" in opened and not recordings.calibrated:
        _say(f"contact is not known: no {options.live.calibration} frames without it, and no --background")


def _opened(config: Any, names: Mapping[str, Sequence[str]], engine: Engine) -> Pack:
    """Every image of ``config`` as ``engine`` takes it; ``names``: modality -> its images, where they have names."""
    if isinstance(config, PackConfig):
        return config.open()
    given: dict[str, Any] = {"vision": names["vision"][0] if names["vision"] else None, "touch": names["touch"] or None}
    given |= {"every": 1} if hasattr(config, "every") else {}
    given |= {"difference": engine.difference} if hasattr(config, "difference") else {}
    side = next(iter(engine.inputs.values()))[0]
    return replace(config, size=side, **{name: value for name, value in given.items() if value}).open()


def _write(out: Path, tables: Iterator[dict[str, Any]], num: int) -> int:
    """Write ``tables``, of at most ``num`` rows in all, as CSV; say how fast they came, and return how many they were."""
    start, written = time.monotonic(), 0

    def write(file: Any) -> None:
        nonlocal written
        made: list[CSVWriter] = []
        with shown(), work("predicting", num, "frames") as advance, ExitStack() as stack:
            for table in map(pa.table, tables):
                made = made or [stack.enter_context(CSVWriter(file, table.schema))]
                made[0].write_table(table)
                written += table.num_rows
                advance(table.num_rows)
        if not written:
            raise ValueError("no frame has every image that the model takes: nothing is written")

    write_atomic(out, write)
    _say(f"written: {out}, {written} frames, {written / (time.monotonic() - start):.0f} a second")
    return written


def sources(
    inputs: Mapping[str, Sequence[int]], vision: str | None, touch: Sequence[str]
) -> dict[str, tuple[str, ...]]:
    """The sources by modality: those that were given, or simulated sensors if there are none.

    ``inputs``: modality -> shape [S, S, C] of an input. ValueError if only some have a source: none is simulated then.
    """
    given: dict[str, tuple[str, ...]] = {"vision": (vision,) if vision else (), "touch": tuple(touch)}
    if not (given := {modality: texts for modality, texts in given.items() if texts}):
        return {m: tuple(f"sim:{i}" for i in range(shape[2] // 3)) for m, shape in inputs.items()}
    for modality in inputs.keys() - given.keys():
        raise ValueError(f"the model takes {modality} too: give --{modality} SOURCE (sim for a simulated one)")
    for modality in given.keys() - inputs.keys():
        raise ValueError(f"the model has no input for {modality}: leave --{modality} out")
    return given


def _engine(model: str, threads: int, modalities: tuple[Any, ...] = (), *, most: int = 2) -> Engine:
    """The engine of an export, of at most ``most`` inputs; a run or an artifact is exported first, once, into the cache."""

    def check(inputs: Iterable[str]) -> None:
        if len([*inputs]) > most:
            raise ValueError("the model takes vision and touch: give --vision SOURCE, --touch SOURCE, or both")

    if (Path(model) / EXPORT.name).is_file():
        check((engine := Engine(model, threads=threads)).inputs)
        return engine
    check_models(model)
    loading()
    from mvitac.cli.deploy import warn_changed
    from mvitac.deploy.artifact import load
    from mvitac.deploy.export import ExportConfig, export
    from mvitac.deploy.publish import own_data, with_probes
    from mvitac.nn.weights import safetensors_digest

    loaded = load(model)
    check(modalities or loaded.encoders)  # before the export, which takes longer
    for m in {*modalities} - {*loaded.encoders}:
        raise ValueError(f"the model has no input for {m}: leave --{m} out")
    # Artifacts of one run differ in their probes. A run has none: its data, as it is now, decides those that are fitted.
    probes: list[Any] = [[to_json(r.info), safetensors_digest(dict(r.state_dict()))] for r in loaded.probes.values()]
    how = "`mvitac export MODEL --on PACK --out DIR` first, and give DIR"
    if (pack := None if probes else own_data(loaded, how)) is not None:
        warn_changed(model, pack)
    about = [to_json(loaded.spec), probes or (pack and [pack.digest, to_json(pack.spec)])]
    folder = cache_dir() / "exports" / digest([EXPORT.version, loaded.weights_digest(), about, *modalities])[:32]
    if not folder.exists():
        _say(f"exporting {model}, once")
        pack = pack or own_data(loaded, how, few=100)
        with shown():
            export(with_probes(loaded, pack), pack, folder, ExportConfig(modalities=modalities))
    return Engine(folder, threads=threads)


def _say_uncropped(engine: Engine, given: Mapping[str, Sequence[str | None]]) -> None:
    """Warn of sources that are used whole, although the model's data showed a part."""
    for m, part in engine.crop.items():
        if any("#" not in f"{text}" and not f"{text}".startswith("sim") for text in given.get(m, ())):
            how = "add that to SOURCE, #x:y:width:height"
            _say(f"mvitac: warning: {m} is used whole, the model learned from {part}: {how}")


def _say_sensors(engine: Engine, names: Iterable[str]) -> None:
    for about in sorted({about_sensor(engine, name) for name in names} - {""}):
        _say(about)


def _say(text: str) -> None:
    sys.stderr.write(f"{text}\n")  # at once: several threads speak
    sys.stderr.flush()
