"""``mvitac live``: predict from the frames of cameras and tactile sensors, one answer for every touch."""

import json
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console, Group
from rich.live import Live as Screen
from rich.table import Table
from rich.text import Text
from tyro.conf import Positional

from mvitac.cli.options import check_json, parse
from mvitac.data.spec import task_title
from mvitac.deploy.engine import EXPORT, Engine, about_sensor, frame_shapes, frames_of
from mvitac.live.cameras import source
from mvitac.live.contact import LiveConfig
from mvitac.live.display import Window, draw
from mvitac.live.predictor import Live
from mvitac.live.recorder import Recorder, finish
from mvitac.live.streams import CaptureThread, Stream
from mvitac.registry import to_json
from mvitac.system.files import cache_dir, digest, write_atomic, write_json

_REDRAW = 0.1  # seconds between two pictures of the terminal or the window


@dataclass(frozen=True, kw_only=True)
class _Options:
    """Predict from live frames: only the newest frame counts, old ones are never used, every fault is reported. Ctrl-C ends
    it with a summary.

    A SOURCE is a camera (its number, /dev/videoN or serial:NAME; @WIDTHxHEIGHT and @FPS after it ask for that mode, e.g.
    serial:D20345@320x240@60), a video file, a folder of pictures[@FPS], or sim[:SEED].
    To finish a recording after a crash: mvitac live --finish DIR
    """

    model: Positional[str]
    """Folder of an export (fastest); or of a run or an artifact, or owner/name on the Hub, which is exported first."""
    vision: str | None = None
    """SOURCE of the camera."""
    touch: tuple[str, ...] = ()
    """SOURCE of the touch sensor, or of both of a gripper: left right. Without any source, all are simulated."""
    sensor: str = ""
    """Name of the touch sensor, as in column sensor of the training data: live says if the model never met it."""
    index: Path | None = None
    """Show the nearest known touches from this index."""
    record: Path | None = None
    """Record the frames in this new folder."""
    record_fps: float = 10.0
    """Pairs per second to record."""
    window: bool = False
    """Also show the frames and answers in a window; q or Esc in it ends. Needs a display and opencv-python."""
    seconds: float | None = None
    """Stop after this many seconds."""
    threads: int = 0
    """CPU threads for the model; 0 = all cores."""
    stale: float = 0.5
    """Age in seconds from which a frame is too old to be used."""
    json: Path | None = None
    """Write the summary to this file."""
    predictions: Path | None = None
    """Write every prediction to this file: one JSON object per line, with time in seconds, classes with confidence, and
    values with unit and spread."""
    plot: Path | None = None
    """Draw the predicted values (force, ...) against time into this PNG at the end. Needs a model with values."""
    live: Annotated[LiveConfig, tyro.conf.arg(name="")] = LiveConfig()


def live(argv: list[str]) -> None:
    """mvitac live MODEL [--vision SOURCE] [--touch SOURCE...] [--index DIR] [--record DIR]"""
    if argv[:1] == ["--finish"] and len(argv) == 2:
        print(f"{argv[1]}: {finish(Path(argv[1]))} pairs")
        return
    options = parse(_Options, argv, "live")
    for name, seconds in (("--seconds", options.seconds), ("--stale", options.stale)):
        if seconds is not None and not seconds > 0:
            raise ValueError(f"{name} {seconds:g}: give seconds, more than 0")
    check_json(options.json)
    check_json(options.predictions, "--predictions")
    check_json(options.plot, "--plot")
    console = Console(markup=False)
    window = Window() if options.window else None
    engine = _engine(options.model, options.threads, console)
    if options.plot and not engine.values:
        raise ValueError(f"--plot draws values over time, and {options.model} predicts classes only: leave it out")
    nearest = _nearest(options, engine)
    streams: Any = _streams(options, engine)
    if not (options.vision or options.touch):
        print("no --vision, no --touch: all sensors are simulated")
    sensor = options.sensor or next((stream.origin.sensor for stream in streams.get("touch", ())), "")
    if said_first := about_sensor(engine, sensor):
        print(said_first)
    recorder = None
    if options.record:
        channels = {m: s[2] for m, s in frame_shapes(engine).items()}
        how: Any = {"fps": options.record_fps, "sensor": sensor}
        recorder = Recorder(options.record, channels, **how, tell=lambda text: _say(console, text, "yellow"))
    # Faults are printed above the picture, so that they stay in the scrollback and in a log file.
    tell = lambda event: _say(console, event.text, "yellow")  # noqa: E731
    loop = Live(engine, streams, options.live, nearest=nearest, record=recorder, tell=tell)
    said: list[Any] = []
    with options.predictions.open("w") if options.predictions else nullcontext() as file:

        def keep(new: Any) -> None:
            if file:
                file.write(json.dumps(new) + "\n")
            if options.plot:
                said.append(new)

        _run(loop, console, window, options.seconds, keep)
    summary = loop.summary()
    _print_summary(console, summary)
    if options.json:
        write_json(options.json, summary)
    if options.plot:
        _plot(said, options.plot)
    if recorder:  # last, for it may fail (a full disk)
        num = recorder.close()
        print(f"recorded: {options.record}, {num} pairs" if num else "nothing was recorded")


def _plot(predictions: list[Any], path: Path) -> None:
    """Draw the values of ``predictions`` over time, if there are any."""
    from mvitac.report.figures import to_png
    from mvitac.report.value_figures import over_time

    if not any(said["contact"] for said in predictions):
        print("nothing was drawn: no touch was seen")
        return
    picture = to_png(over_time(predictions))
    write_atomic(path, lambda file: file.write(picture))
    print(f"values over time: {path}")


def _nearest(options: _Options, engine: Engine) -> Any:
    """The search for known touches, if there is an index; ValueError if it was made with another model."""
    from mvitac.deploy.search import Index, neighbours

    if not options.index:
        return None
    index = Index(options.index)
    if index.meta["weights"] != engine.meta["weights"]:
        raise ValueError(f"{options.index} was made with another model: index the pack again with {options.model}")
    return neighbours(index, options.live.neighbours, engine.inputs)


def _streams(options: _Options, engine: Engine) -> dict[str, list[Any]]:
    """The streams by modality, not yet open; several of one modality are numbered from 1."""
    streams = {}
    for modality, texts in sources(frame_shapes(engine), options.vision, options.touch).items():
        names = [modality] if len(texts) == 1 else [f"{modality} {i + 1}" for i in range(len(texts))]
        found = [source(text, modality, frames_of(engine.window, modality)) for text in texts]
        pairs = zip(names, found, strict=True)
        streams[modality] = [Stream(name, origin, stale_after=options.stale) for name, origin in pairs]
    return streams


def _run(
    loop: Live,
    console: Console,
    window: Window | None,
    seconds: float | None,
    write: Callable[[Any], object] = lambda said: None,
) -> None:
    """Predict until all streams ended, ``seconds`` are over, or the user stops it; ``write`` gets every prediction."""
    start = loop.clock()
    end = time.monotonic() + seconds if seconds else float("inf")
    printed, drawn = 0, 0.0
    with (
        _capture(loop, window, console) as news,
        Screen(view(loop), console=console, auto_refresh=False, transient=True, vertical_overflow="crop") as screen,
    ):
        try:
            while time.monotonic() < end and not all(s.ended for s in loop.all):
                news.wait(0.05)
                news.clear()
                if loop.tick():
                    write({"time": round(loop.clock() - start, 4), **loop.prediction()})
                printed = _print_touch(loop, console, printed)
                if time.monotonic() - drawn > _REDRAW:
                    screen.update(view(loop), refresh=True)
                    if window and not window.show(draw(loop)):
                        break
                    drawn = time.monotonic()
        finally:
            # rich draws the last picture in full, and cannot erase what scrolls out of a low terminal.
            screen.update(Text(), refresh=True)
    loop.finish()
    _print_touch(loop, console, printed)


@contextmanager
def _capture(loop: Live, window: Window | None, console: Console) -> Iterator[threading.Event]:
    """Read every stream in a thread of its own; the event is set by each new frame. Ctrl-C ends the ``with``."""
    news = threading.Event()
    threads = [CaptureThread(stream, news.set) for stream in loop.all]
    for thread in threads:
        thread.start()
    try:
        yield news
    except KeyboardInterrupt:
        console.print("stopped")
    finally:
        for thread in threads:
            thread.stopping.set()
        for thread in threads:
            thread.join(2.0)  # a device that hangs must not hang us
        if window:
            window.close()


def sources(
    inputs: Mapping[str, Sequence[int]], vision: str | None, touch: Sequence[str]
) -> dict[str, tuple[str, ...]]:
    """The sources by modality: those that were given, or simulated sensors if there are none.

    ``inputs``: modality -> shape [S, S, C] of an input. ValueError if only some have a source: a simulated sensor must
    not pass for a real one.
    """
    given: dict[str, tuple[str, ...]] = {"vision": (vision,) if vision else (), "touch": tuple(touch)}
    given = {modality: texts for modality, texts in given.items() if texts}
    if not given:
        return {m: tuple(f"sim:{i}" for i in range(shape[2] // 3)) for m, shape in inputs.items()}
    for modality in inputs.keys() - given.keys():
        source = f"--{modality} SOURCE (--{modality} sim for a simulated one)"
        raise ValueError(f"the model takes {modality} too: give {source}")
    for modality in given.keys() - inputs.keys():
        raise ValueError(f"the model has no input for {modality}: leave --{modality} out")
    return given


def _engine(model: str, threads: int, console: Any) -> Engine:
    """The engine of an export; a run or an artifact is exported first, once, into the cache."""
    from mvitac.deploy.artifact import load
    from mvitac.deploy.export import export
    from mvitac.deploy.publish import own_data, with_probes
    from mvitac.nn.weights import safetensors_digest

    if (Path(model) / EXPORT.name).is_file():
        return Engine(model, threads=threads)
    loaded = load(model)
    # Artifacts of one run differ in their probes only. A run has none: its data decides those that are fitted below.
    probes = [[to_json(r.info), safetensors_digest(dict(r.state_dict()))] for r in loaded.probes.values()]
    key = digest([EXPORT.version, loaded.weights_digest(), probes])
    folder = cache_dir() / "exports" / key[:32]
    if not folder.exists():
        console.print(f"exporting {model}, once", soft_wrap=True, highlight=False)
        pack = own_data(loaded, "`mvitac export MODEL --on PACK --out DIR` first, and give DIR")
        export(with_probes(loaded, pack), pack, folder)
    return Engine(folder, threads=threads)


def _print_touch(loop: Live, console: Any, printed: int) -> int:
    """Print one line for a touch that has ended; the number of the last touch printed."""
    touch = loop.last
    if touch is None or touch.number <= printed or touch.end is None:
        return printed
    answers = "; ".join(
        [_answer(loop, *item) for item in loop.answers(touch).items()]
        + [f"{r.name}: {r.over_touch()}" for found in loop.readings(touch).values() for r in found]
    )
    like = f"; like: {'; '.join(touch.known)}" if touch.known else ""
    text = f"touch {touch.number} ({touch.end - touch.start:.1f} s): {answers}{like}"
    _say(console, text)
    return touch.number


def _say(console: Console, text: str, style: str = "") -> None:
    """Print above the picture."""
    console.print(text, style=style, soft_wrap=True, highlight=False, markup=False)


def _answer(loop: Live, task: str, answer: tuple[str, float]) -> str:
    name, confidence = answer
    sure = "" if confidence >= loop.config.min_confidence else ", unsure"
    return f"{task_title(task, loop.engine.classes[task])}: {name} ({100 * confidence:.0f} %{sure})"


def view(loop: Live) -> Any:
    """The terminal's picture of ``loop``: streams, contact, answers, ages; 80 columns wide."""
    lines: list[Any] = [_stream_table(loop)]
    for s in loop.streams.get("touch", ()):
        contact = loop.contacts[s.name]
        bar = "#" * min(30, round(10 * contact.level))
        state = f"{'CONTACT' if contact.touched else 'free   '} {bar}"
        lines.append(Text(f"{s.name:8} {'unknown' if s.fault else state}"))
    touch = loop.touch or loop.last
    titles = {task: task_title(task, classes) for task, classes in loop.engine.classes.items()}
    values = [reading for found in loop.readings(touch).values() for reading in found]
    wide = max([10, *map(len, titles.values()), *(len(reading.name) for reading in values)])
    for task, (name, confidence) in loop.answers(touch).items():
        sure = "" if confidence >= loop.config.min_confidence else "  unsure"
        bar = "#" * round(20 * confidence)
        lines.append(Text(f"{titles[task]:{wide}} {name:18} {bar:20} {100 * confidence:3.0f} %{sure}"))
    lines += [Text(f"{reading.name:{wide}} {reading}") for reading in values]
    if touch and touch.known:
        lines.append(Text("like: " + "; ".join(touch.known)))
    age = loop.summary()["age_ms"]
    if age["p50"] is not None:
        text = "age p50 {p50:.1f}  p99 {p99:.1f}  max {max:.1f} ms".format(**age)
        lines.append(Text(f"{text}   predictions {loop.num_predictions}   stale {loop.num_stale}"))
    return Group(*lines)


def _stream_table(loop: Live) -> Table:
    table = Table(box=None, pad_edge=False)
    for column in ("stream", "fps", "age ms", "dropped", "state"):
        table.add_column(column, justify="left" if column in ("stream", "state") else "right")
    for s in loop.all:
        age = f"{1000 * s.age():.0f}" if s.num_frames else "-"
        table.add_row(s.name, f"{s.rate():.1f}", age, str(s.num_dropped), loop.state(s))
    return table


def _print_summary(console: Console, summary: dict[str, Any]) -> None:
    age = summary["age_ms"]
    if age["p50"] is not None:
        _say(console, "end-to-end age, ms: p50 {p50:.1f}, p99 {p99:.1f}, max {max:.1f}".format(**age))
    _say(console, "{predictions} predictions in {touches} touches; {stale} frames too old to use".format(**summary))
    for name, s in summary["streams"].items():
        _say(console, f"{name}: {s['frames']} frames, {s['dropped']} dropped for newer ones, {s['damaged']} damaged")
    if summary["events"]:
        _say(console, "events: " + ", ".join(f"{k} {v}" for k, v in summary["events"].items()))
