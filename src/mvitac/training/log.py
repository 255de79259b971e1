"""Logging of a run: log.jsonl, the progress bar, and optional loggers (TensorBoard, Weights & Biases, Trackio)."""

import importlib
import json
import re
import textwrap
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from statistics import mean
from typing import Any

from mvitac.data.pack import Pack
from mvitac.registry import check_known, to_json
from mvitac.run import Run
from mvitac.system.files import brief, check_ordinary, naming, parse_json, write_atomic
from mvitac.system.progress import say, shown, work

Logger = Callable[[int, dict[str, float]], None]  # called with a step and the values logged at it
WIDTH = 80  # columns of a terminal
RETRIEVED = "R@5"
EARLY = 3  # step of the first log line, so that the speed is known soon


class Log:
    """Writes log.jsonl, the progress bar and the loggers.

    Lines after step ``start`` (the number of steps that are already done) are removed from the log.jsonl in ``out``.
    """

    def __init__(
        self, out: Path, run: Run, pack: Pack, start: int, num_steps: int, *, quiet: bool, loggers: tuple[Logger, ...]
    ) -> None:
        self.path = out / "log.jsonl"
        kept = [entry for entry in read_log(out) if entry["step"] <= start] if start else []
        self.first = next((entry["eval"] for entry in kept if entry["step"] == 0 and "eval" in entry), {})
        write_atomic(self.path, lambda file: file.write("".join(json.dumps(entry) + "\n" for entry in kept).encode()))
        self.file = self.path.open("a")
        self.loggers, self.start, self.since, self.since_step = loggers, start, time.perf_counter(), start
        self.num_steps, self.batch_size, self.quiet, self.stack = num_steps, run.batch_size, quiet, ExitStack()
        self.advance_bar: Callable[[int, str], None] = lambda num, text: None
        self.measured, self.begun = {task.name for task in pack.spec.values}, False
        self.loss, self.speed = "", ""  # the latest ones, as text

    def __enter__(self) -> "Log":
        if not self.quiet:
            self.stack.enter_context(shown())
            self.advance_bar = self.stack.enter_context(work("training", self.num_steps, "steps", done=self.start))
        return self

    def __exit__(self, *_: object) -> None:
        self.stack.close()
        with naming(self.path):
            self.file.close()

    def step(self, step: int, losses: dict[str, float], lr: float) -> None:
        now = time.perf_counter()
        speed = (step - self.since_step) * self.batch_size / max(1e-9, now - self.since)
        self.since, self.since_step = now, step
        self._write({**losses, "step": step, "lr": lr, "pairs_per_s": round(speed, 1)})
        self.loss, self.speed = f"{losses['loss']:.2f}", f"{speed:.0f}"

    def advance(self, step: int) -> None:
        if step == self.start + 1:  # the first step includes start-up: do not measure it
            self.since, self.since_step = time.perf_counter(), step
        self.advance_bar(1, f"loss {self.loss}, {self.speed} pairs/s" if self.loss else "")

    def evaluation(self, step: int, values: dict[str, float], verdict: Sequence[str] = ()) -> None:
        """Log ``values`` of an evaluation, and print a row of the table; ``verdict``: clauses about the whole run."""
        self._write({"step": step, "eval": values, **({"verdict": "; ".join(verdict)} if verdict else {})})
        if step == 0:
            self.first = values
        if columns := shown_scores(values):
            self._row(step, columns, values)
        for clause in verdict:
            if "neither: " in clause:  # their figures are in log.jsonl
                clause = re.sub(r" [+-][\d.]+( \[[^]]*\])?", "", clause)
            self.say(textwrap.fill(clause, WIDTH, subsequent_indent="    "))

    def _row(self, step: int, columns: dict[str, list[str]], values: dict[str, float]) -> None:
        widths = _widths(list(columns))
        if not self.begun:
            self.begun = True
            self._heads(columns, widths, values)
        both = values, self.first or values
        now, then = ({n: 100 * mean(found[k] for k in keys) for n, keys in columns.items()} for found in both)
        gain = mean(now[name] - then[name] for name in columns if name != RETRIEVED or len(columns) == 1)
        cells = [f"{now[name]:.1f}" for name in widths]
        self.say(_line([str(step), self.loss, self.speed], cells, f"{gain:+.1f}" if step else "", widths))

    def _heads(self, columns: dict[str, list[str]], widths: dict[str, int], values: dict[str, float]) -> None:
        both = " by touch and vision" * any("both/" in key for keys in columns.values() for key in keys)
        unseen = any(rows for key, rows in values.items() if key.endswith("held-out rows"))
        where = "on held-out groups (split val)" if unseen else "on training rows (split val has none)"
        about = f"{where}: linear probe{both}; change of the mean in points"
        if "chance R@5" in values:
            about += f"; R@5 by chance {100 * values['chance R@5']:.1f}"
        if left := len(columns) - len(widths):
            about += f"; {left} more in log.jsonl"
        self.say(textwrap.fill(about, WIDTH))
        kinds = dict.fromkeys(self.measured, "R2 %") | {RETRIEVED: "%"}
        self.say(_line(["step", "loss", "pairs/s"], list(widths), "change", widths))
        self.say(_line([""] * 3, [kinds.get(name.rpartition(" ")[2], "acc %") for name in widths], "", widths))

    def say(self, text: str) -> None:
        """Print ``text`` on a line above the progress bar."""
        if not self.quiet:
            say(text)

    def _write(self, entry: dict[str, Any]) -> None:
        with naming(self.path):
            self.file.write(json.dumps(entry) + "\n")
            self.file.flush()
        flat = {k: v for k, v in {**entry, **entry.get("eval", {})}.items() if isinstance(v, float)}
        for logger in self.loggers:
            logger(entry["step"], flat)


def shown_scores(values: dict[str, float]) -> dict[str, list[str]]:
    """Columns of the table of evaluations -> names of their scores in ``values``, of which they are the mean.

    A task is shown by both modalities, where there are two. ``RETRIEVED`` is the mean of both directions.
    """
    found: dict[str, list[str]] = {}
    for key in values:
        if score := re.fullmatch(r"(?:(.+) )?\w+/linear (.+)", key):
            found[" ".join(filter(None, score.groups()))] = [key]  # both comes last
    retrieved = [key for key in values if re.search(r"->\w+ R@5$", key)]
    return found | ({RETRIEVED: retrieved} if retrieved else {})


def _widths(names: list[str]) -> dict[str, int]:
    """Columns that fit into a line of ``WIDTH``, and their widths: the widest are cut, then the last tasks left out."""
    room = WIDTH - len(_line(["", "", ""], [], "change", {}))
    most = room // 6
    names = names if len(names) <= most else [*names[: most - 1], names[-1]]  # retrieval is the last
    widths = [max(5, len(name)) for name in names]
    while sum(widths) + len(widths) > room:
        widths[widths.index(max(widths))] -= 1
    return dict(zip(names, widths, strict=True))


def _line(first: list[str], cells: list[str], last: str, widths: dict[str, int]) -> str:
    shown = [f"{cell[:width]:>{width}}" for cell, width in zip(cells, widths.values(), strict=True)]
    return " ".join([f"{first[0]:>6}{first[1]:>7}{first[2]:>8}", *shown, f"{last:>6}"]).rstrip()


def read_log(run: Path) -> list[dict[str, Any]]:
    """Entries of the log.jsonl in a run's folder. An incomplete line, written when the run was killed, ends them."""
    path, entries = run / "log.jsonl", []
    check_ordinary(path)  # a pipe never ends
    for line in path.read_text(errors="replace").splitlines() if path.exists() else ():
        try:
            entry = parse_json(line)
        except ValueError:
            break
        scores = entry.get("eval", {}) if isinstance(entry, dict) else None
        if not isinstance(scores, dict) or not isinstance(entry.get("step"), int):
            break
        if not all(isinstance(x, int | float) for x in {**entry, **scores, "eval": 0, "verdict": 0}.values()):
            break
        entries.append(entry)
    return entries


def seconds_of(entries: Iterable[dict[str, Any]], batch_size: int) -> float:
    """Seconds of training by the speeds in a log, over all resumptions. Steps lost to a kill are not counted."""
    total, before = 0.0, 0
    for entry in entries:
        if entry.get("pairs_per_s"):
            total += (entry["step"] - before) * batch_size / entry["pairs_per_s"]
            before = entry["step"]
    return total


LOGGERS = ("tensorboard", "wandb", "trackio")


@contextmanager
def open_loggers(name: str | None, out: Path, run: Run) -> Iterator[tuple[Logger, ...]]:
    """Open the logger ``name`` for the run in ``out``; yields the loggers for ``train``: one, or none without a name."""
    if name is None:
        yield ()
        return
    check_known("logger", [name], LOGGERS)
    try:
        library = importlib.import_module("torch.utils.tensorboard" if name == "tensorboard" else name)
    except ImportError:
        raise ValueError(f"--logger {name} needs its library: pip install -e '.[{name}]' in mvitac's clone") from None
    started: list[Any] = []
    board = name == "tensorboard"

    @contextmanager
    def named() -> Iterator[None]:
        try:
            yield
        except Exception as error:  # each library has its own
            raise ValueError(f"--logger {name}: {brief(error)}; mend it, or leave it out, and --resume") from None

    def send(step: int, values: dict[str, float]) -> None:
        with named():
            if not started:  # only now: a run that is refused must leave no files, since --out must be new
                about = {"project": "mvitac", "name": out.name, "config": to_json(run)}
                started.append(library.SummaryWriter(str(out / "tensorboard")) if board else library.init(**about))
            if board:
                for key, value in values.items():
                    started[0].add_scalar(key, value, step)
            else:  # wandb and trackio have the same functions
                library.log(values, step=step)

    try:
        yield (send,)
    finally:
        for writer in started:
            with named():
                writer.close() if board else library.finish()
