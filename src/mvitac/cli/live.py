"""``mvitac live``: a robot's eyes and fingers in, a prediction for every touch out."""

import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mvitac.cli.options import parse

if TYPE_CHECKING:
    from mvitac.deploy.engine import Engine
    from mvitac.live.predictor import Live


def live(argv: list[str]) -> None:
    """mvitac live MODEL [--vision SOURCE] [--touch SOURCE...] [--index DIR] [--record DIR]"""
    from typing import Annotated, Literal

    import tyro
    from rich.console import Console
    from rich.live import Live as Screen

    from mvitac.deploy.search import Index, neighbours
    from mvitac.live.cameras import source
    from mvitac.live.contact import LiveConfig
    from mvitac.live.display import Window, draw
    from mvitac.live.predictor import Live
    from mvitac.live.recorder import Recorder, finish
    from mvitac.live.streams import CaptureThread, Stream
    from mvitac.system.files import check_place, write_json

    if argv[:1] == ["--finish"] and len(argv) == 2:
        Console(markup=False).print(f"{argv[1]}: {finish(Path(argv[1]))} pairs", soft_wrap=True, highlight=False)
        return

    @dataclass(frozen=True, kw_only=True)
    class Options:
        """Predict from live frames: the newest always wins, old ones are never used, every fault is named. Ctrl-C ends it
        with a summary.

        A SOURCE is a camera (its number, /dev/videoN or serial:NAME; with @WIDTHxHEIGHT and @FPS it is asked for that mode,
        e.g. serial:D20345@320x240@60), a video file, a folder of pictures[@FPS], or sim[:SEED].
        A recording that a crash cut short: mvitac live --finish DIR
        """

        model: tyro.conf.Positional[str]
        """An export's folder (fastest); or a run, an artifact, owner/name on the Hub, which is exported first."""
        vision: str | None = None
        """The camera."""
        touch: tuple[str, ...] = ()
        """The touch sensor, or both of a gripper: left right. Without any source, all of them are simulated."""
        index: Path | None = None
        """Show the nearest known touches from this index."""
        record: Path | None = None
        """Record what comes in, in this new folder."""
        record_as: Literal["pack", "lerobot"] = "pack"
        """What the recording becomes: a pack, or a LeRobotDataset v3 (an episode per touch)."""
        record_fps: float = 10.0
        """Pairs a second to record; a whole number for lerobot."""
        window: bool = False
        """Show the frames and answers in a window too; q or Esc in it ends. Needs a display and opencv-python."""
        seconds: float | None = None
        """Stop after so long."""
        threads: int = 0
        """CPU threads for the model; 0 = all cores."""
        stale: float = 0.5
        """Seconds after which a frame is too old to be used."""
        json: Path | None = None
        """Write the summary to this file."""
        live: Annotated[LiveConfig, tyro.conf.arg(name="")] = LiveConfig()

    options = parse(Options, argv, "live")
    for name, seconds in (("--seconds", options.seconds), ("--stale", options.stale)):
        if seconds is not None and not seconds > 0:
            raise ValueError(f"{name} {seconds:g}: give seconds, more than 0")
    if options.json:
        check_place(options.json)
        if options.json.is_dir():
            raise ValueError(f"--json {options.json} is a folder: give a file's name")
    console = Console(markup=False)
    window = Window() if options.window else None
    engine = _engine(options.model, options.threads, console)
    index = Index(options.index) if options.index else None
    if index and index.meta["weights"] != engine.meta["weights"]:
        raise ValueError(f"{options.index} was made with another model: index the pack again with {options.model}")
    streams = {}
    for modality, texts in sources(engine.inputs, options.vision, options.touch).items():
        names = [modality] if len(texts) == 1 else [f"{modality} {i + 1}" for i in range(len(texts))]
        pairs = zip(names, texts, strict=True)
        streams[modality] = [Stream(name, source(text, modality), stale_after=options.stale) for name, text in pairs]
    if not (options.vision or options.touch):
        console.print("no --vision, no --touch: all sensors are simulated", highlight=False)
    recorder = None
    if options.record:
        channels = {m: s[2] for m, s in engine.inputs.items()}
        recorder = Recorder(options.record, channels, fps=options.record_fps, form=options.record_as)
    nearest = neighbours(index, options.live.neighbours, engine.inputs) if index else None
    # What happened is printed above the picture, so that it stays in the scrollback and in a log file.
    loop = Live(
        engine,
        streams,
        options.live,
        nearest=nearest,
        record=recorder,
        tell=lambda event: console.print(event.text, style="yellow", soft_wrap=True, highlight=False, markup=False),
    )
    news = threading.Event()
    threads = [CaptureThread(stream, news.set) for stream in loop.all]
    end = time.monotonic() + options.seconds if options.seconds else float("inf")
    spoken = 0
    for thread in threads:
        thread.start()
    try:
        with Screen(view(loop), console=console, auto_refresh=False, transient=True) as screen:
            drawn = 0.0
            while time.monotonic() < end and not all(s.ended for s in loop.all):
                news.wait(0.05)
                news.clear()
                loop.tick()
                spoken = _speak(loop, console, spoken)
                if time.monotonic() - drawn > 0.1:
                    screen.update(view(loop), refresh=True)
                    if window and not window.show(draw(loop)):
                        break
                    drawn = time.monotonic()
    except KeyboardInterrupt:
        console.print("stopped")
    finally:
        for thread in threads:
            thread.stopping.set()
        for thread in threads:
            thread.join(2.0)  # a device that hangs must not hang us
        if window:
            window.close()
    loop.finish()
    _speak(loop, console, spoken)
    summary = loop.summary()
    _conclude(summary, console)
    if options.json:
        write_json(options.json, summary)
    if recorder:  # last, for it may fail (a full disk)
        num = recorder.close()
        console.print(f"recorded: {options.record}, {num} pairs" if num else "nothing was recorded", soft_wrap=True)


def sources(
    inputs: Mapping[str, Sequence[int]], vision: str | None, touch: Sequence[str]
) -> dict[str, tuple[str, ...]]:
    """What to open by modality, for an engine's ``inputs`` (shapes [S, S, C] by modality): what was given, or simulated
    sensors if nothing was. ValueError if one of them is left out: what is simulated must not pass for real."""
    given: dict[str, tuple[str, ...]] = {"vision": (vision,) if vision else (), "touch": tuple(touch)}
    given = {modality: texts for modality, texts in given.items() if texts}
    if not given:
        return {m: tuple(f"sim:{i}" for i in range(shape[2] // 3)) for m, shape in inputs.items()}
    for modality in inputs.keys() - given.keys():
        raise ValueError(
            f"the model takes {modality} too: give --{modality} SOURCE (--{modality} sim for a simulated one)"
        )
    for modality in given.keys() - inputs.keys():
        raise ValueError(f"the model has no input for {modality}: leave --{modality} out")
    return given


def _engine(model: str, threads: int, console: Any) -> "Engine":
    """An export as it is; anything else exported once, into the cache."""
    from mvitac.deploy.artifact import load
    from mvitac.deploy.engine import FORMAT_VERSION, MANIFEST, Engine, lists_bf16
    from mvitac.deploy.export import export
    from mvitac.deploy.publish import own_data, with_readouts
    from mvitac.model import safetensors_digest
    from mvitac.registry import to_json
    from mvitac.system.files import cache_dir, digest

    if (Path(model) / MANIFEST).is_file():
        engine = Engine(model, threads=threads)
        if engine.meta["precision"] == "bf16":
            import openvino

            if not lists_bf16(openvino.Core()):
                console.print(f"{model} is in bf16, which this CPU lacks: it runs in fp32, slower", soft_wrap=True)
        return engine
    loaded = load(model)
    # Artifacts of one run differ in their probes alone. A bare run has none: those fitted below are what its data makes.
    probes = [[to_json(r.question), safetensors_digest(dict(r.state_dict()))] for r in loaded.readouts.values()]
    key = digest([FORMAT_VERSION, loaded.weights_digest(), probes])
    folder = cache_dir() / "exports" / key[:32]
    if not folder.exists():
        console.print(f"exporting {model} for ONNX Runtime, once", soft_wrap=True, highlight=False)
        pack = own_data(loaded, "`mvitac export` it where the data is, and give that folder")
        export(with_readouts(loaded, pack), pack, folder, kind="onnx")
    return Engine(folder, threads=threads)


def _speak(loop: "Live", console: Any, spoken: int) -> int:
    """One line for a touch that has ended."""
    touch = loop.last
    if touch is None or touch.number <= spoken or touch.end is None:
        return spoken
    said = ", ".join(_answer(loop, *item) for item in loop.answers(touch).items())
    like = f"; like: {'; '.join(touch.known)}" if touch.known else ""
    text = f"touch {touch.number} ({touch.end - touch.start:.1f} s): {said}{like}"
    console.print(text, soft_wrap=True, highlight=False, markup=False)
    return touch.number


def _answer(loop: "Live", task: str, answer: tuple[str, float]) -> str:
    name, confidence = answer
    sure = "" if confidence >= loop.config.min_confidence else ", unsure"
    return f"{task} {name} ({100 * confidence:.0f} %{sure})"


def view(loop: "Live") -> Any:
    """The terminal's picture of ``loop``, 80 columns wide."""
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    streams = Table(box=None, pad_edge=False)
    for column in ("stream", "fps", "age ms", "dropped", "state"):
        streams.add_column(column, justify="left" if column in ("stream", "state") else "right")
    for s in loop.all:
        age = f"{1000 * s.age():.0f}" if s.num_frames else "-"
        streams.add_row(s.name, f"{s.rate():.1f}", age, str(s.num_dropped), loop.state(s))
    lines: list[Any] = [streams]
    for s in loop.streams.get("touch", ()):
        contact = loop.contacts[s.name]
        bar = "#" * min(30, round(10 * contact.level))
        state = f"{'CONTACT' if contact.touched else 'free   '} {bar}"
        lines.append(Text(f"{s.name:8} {'unknown' if s.fault else state}"))
    touch = loop.touch or loop.last
    for task, (name, confidence) in loop.answers(touch).items():
        sure = "" if confidence >= loop.config.min_confidence else "  unsure"
        lines.append(Text(f"{task:10} {name:18} {'#' * round(20 * confidence):20} {100 * confidence:3.0f} %{sure}"))
    if touch and touch.known:
        lines.append(Text("like: " + "; ".join(touch.known)))
    age = loop.summary()["age_ms"]
    if age["p50"] is not None:
        text = "age p50 {p50:.1f}  p99 {p99:.1f}  max {max:.1f} ms".format(**age)
        lines.append(Text(f"{text}   predictions {loop.num_predictions}   stale {loop.num_stale}"))
    return Group(*lines)


def _conclude(summary: dict[str, Any], console: Any) -> None:
    age = summary["age_ms"]
    if age["p50"] is not None:
        console.print("end-to-end age, ms: p50 {p50:.1f}, p99 {p99:.1f}, max {max:.1f}".format(**age), highlight=False)
    console.print(
        f"{summary['predictions']} predictions in {summary['touches']} touches; {summary['stale']} frames too old to use",
        highlight=False,
    )
    for name, s in summary["streams"].items():
        console.print(
            f"{name}: {s['frames']} frames, {s['dropped']} dropped for newer ones, {s['damaged']} damaged",
            highlight=False,
        )
    if summary["events"]:
        console.print("events: " + ", ".join(f"{k} {v}" for k, v in summary["events"].items()), highlight=False)
