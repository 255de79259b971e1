"""What a run says of itself while it trains: log.jsonl, the progress line, and the sinks one may add; and others of it."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from mvitac.registry import to_json, unknown
from mvitac.run import Run
from mvitac.system.files import naming, write_atomic

Logger = Callable[[int, dict[str, float]], None]
WIDE = 120
"""Columns of a terminal in which all losses stand beside the progress; in fewer their sum alone."""


class Log:
    """log.jsonl, the progress line, and the sinks; on resume, lines after the checkpoint are dropped."""

    def __init__(self, out: Path, start: int, num_steps: int, quiet: bool, loggers: tuple[Logger, ...]) -> None:
        path = out / "log.jsonl"
        kept = []
        if path.exists():
            for line in path.read_text(errors="replace").splitlines():
                try:
                    entry = json.loads(line)
                    early = entry["step"] <= start
                except (ValueError, TypeError, KeyError):
                    break  # the line that was being written when the run was killed
                if early:
                    kept.append(line + "\n")
        write_atomic(path, lambda file: file.write("".join(kept).encode()))
        self.path, self.file = path, path.open("a")
        self.loggers, self.start, self.since, self.since_step = loggers, start, time.perf_counter(), start
        columns = (TextColumn("{task.description}"), BarColumn(bar_width=16), MofNCompleteColumn())
        times = (TimeElapsedColumn(), TimeRemainingColumn(), TextColumn("{task.fields[text]}"))
        self.progress = Progress(*columns, *times, disable=quiet)
        self.bar = self.progress.add_task("pre-training", total=num_steps, completed=start, text="")

    def __enter__(self) -> Log:
        self.progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.progress.stop()
        with naming(self.path):
            self.file.close()

    def step(self, step: int, losses: dict[str, float], lr: float, batch_size: int) -> None:
        now = time.perf_counter()
        speed = (step - self.since_step) * batch_size / max(1e-9, now - self.since)
        self.since, self.since_step = now, step
        self._write({"step": step, **losses, "lr": lr, "pairs_per_s": round(speed, 1)})
        told = losses if self.progress.console.width >= WIDE else {"loss": losses["loss"]}
        text = " ".join(f"{name} {value:.2f}" for name, value in told.items())
        self.progress.update(self.bar, text=f"{text}  {speed:.0f}/s")

    def advance(self, step: int) -> None:
        self.progress.update(self.bar, completed=step)

    def evaluation(self, step: int, values: dict[str, float]) -> None:
        self._write({"step": step, "eval": values})
        best = [f"{name} {value:.3f}" for name, value in values.items() if "knn" in name or name.endswith("R@5")]
        self.say(f"step {step}: " + ", ".join(best))

    def say(self, text: str) -> None:
        """``text`` on a line of its own above the progress."""
        if not self.progress.disable:
            self.progress.console.print(text, soft_wrap=True, highlight=False, markup=False)

    def _write(self, entry: dict[str, Any]) -> None:
        with naming(self.path):
            self.file.write(json.dumps(entry) + "\n")
            self.file.flush()
        flat = {k: v for k, v in {**entry, **entry.get("eval", {})}.items() if isinstance(v, float)}
        for logger in self.loggers:
            logger(entry["step"], flat)


def bars(console: Console, **options: Any) -> Progress:
    """Bars of runs in other processes; each task has a field ``text`` (``last_line``)."""
    columns = (TextColumn("{task.description}"), BarColumn(bar_width=16), MofNCompleteColumn(), TimeRemainingColumn())
    return Progress(*columns, TextColumn("{task.fields[text]}"), console=console, **options)


def last_line(run: Path) -> tuple[int, str]:
    """The step that the run in a folder has come to, and what its log says of it."""
    try:
        lines = (run / "log.jsonl").read_text().splitlines()
    except OSError:  # not there yet
        return 0, ""
    for line in reversed(lines):
        try:
            entry = json.loads(line)
        except ValueError:  # being written
            continue
        if "loss" in entry:
            return entry["step"], f"loss {entry['loss']:.2f}  {entry['pairs_per_s']:.0f}/s"
    return 0, ""


LOGGERS = ("tensorboard", "wandb", "trackio")


@contextmanager
def open_loggers(name: str | None, out: Path, run: Run) -> Iterator[tuple[Logger, ...]]:
    """The sink called ``name`` (none if None) for the run in ``out``; ValueError if its library is not installed."""
    if name is None:
        yield ()
        return
    if name not in LOGGERS:
        raise unknown("sink", name, LOGGERS)
    try:
        if name == "tensorboard":
            from torch.utils.tensorboard import SummaryWriter

            def start() -> tuple[Logger, Callable[[], object]]:
                writer = SummaryWriter(str(out / "tensorboard"))

                def send(step: int, values: dict[str, float]) -> None:
                    for key, value in values.items():
                        writer.add_scalar(key, value, step)

                return send, writer.close
        else:
            import importlib

            library = importlib.import_module(name)  # wandb and trackio share these three calls

            def start() -> tuple[Logger, Callable[[], object]]:
                library.init(project="mvitac", name=out.name, config=to_json(run))
                return lambda step, values: library.log(values, step=step), library.finish
    except ImportError:
        raise ValueError(f"--sink {name} needs its library: pip install 'mvitac[{name}]'") from None
    # Started by the first values, not before: a run that is refused must leave nothing behind, and --out must be new.
    started: list[tuple[Logger, Callable[[], object]]] = []

    def send(step: int, values: dict[str, float]) -> None:
        if not started:
            started.append(start())
        started[0][0](step, values)

    try:
        yield (send,)
    finally:
        for _, close in started:
            close()
