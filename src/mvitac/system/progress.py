"""Progress of long work, with the time left as estimated from measured steps.

``shown`` opens a display. ``work`` adds a line to it, from any function and any thread. Without ``shown``, e.g. if a
function is called from Python, nothing is printed. A terminal or a notebook shows bars with named columns. A pipe or a
file gets plain lines: the work, the time left after the first measured steps, and then a line about every tenth of the
time.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from rich.progress import BarColumn, Progress, ProgressColumn, Task, TaskID
from rich.table import Column
from rich.text import Text

from mvitac.system.console import Console

WIDE = 120  # terminal width from which all losses and a long bar are shown
FIRST, OFTEN, SELDOM = 5.0, 10.0, 300.0  # seconds before the first plain line, and the minimum and maximum between two
_shown: "list[Bars]" = []


class Bars(Progress):
    """rich's Progress with named columns, or with plain lines where bars cannot be drawn.

    Fields of a task:
        unit: What is counted.
        rate, scale: Unit of the speed, and how many of it one step is (default: ``unit``, 1).
        text: More text.
        left, speed: Seconds left and the speed, if they are not measured from this task's updates.
        silent: Print no plain lines.
    """

    def __init__(self, console: Console | None = None, **options: Any) -> None:
        console = console or Console(markup=False)
        self.live_bars = console.is_interactive or console.is_jupyter
        bar = BarColumn(bar_width=16 if console.width >= WIDE else 6)
        named = (_count, lambda task: f"elapsed {_clock(task.elapsed)}", lambda task: f"left {_clock(time_left(task))}")
        columns = [_Column(lambda task: task.description), bar, *(_Column(say) for say in (*named, _speed, _text))]
        usual = {"disable": not self.live_bars, "transient": True, "speed_estimate_period": 600.0}
        super().__init__(*columns, console=console, **{**usual, **options})
        self._due: dict[str, float] = {}  # by description: several threads may do the same work

    def update(self, task_id: TaskID, **changes: Any) -> None:  # type: ignore[override]
        super().update(task_id, **changes)
        with self._lock:
            if not self.live_bars and (task := self._tasks.get(task_id)) and not task.fields.get("silent"):
                self._tell(task)

    def say(self, text: str) -> None:
        """Print a line, above the bars if there are any."""
        self.console.print(text, soft_wrap=True, highlight=False, markup=False)

    def end(self, task_id: TaskID, *, always: bool = True) -> None:
        """Remove a task's bar and print a summary; for short work only if ``always``."""
        task = self._tasks[task_id]
        self.remove_task(task_id)
        told = self._due.pop(task.description, None) is not None
        if task.finished and (always or told):
            spent = duration(task.finished_time or 0)
            self.say(f"{task.description}: {_count(task)} in {spent}{_bracketed(_speed(task))}")

    def _tell(self, task: Task) -> None:
        name, now, left = task.description, self.get_time(), time_left(task)
        spent = task.elapsed or 0.0
        if left is not None and not task.finished and now >= self._due.get(name, now - spent + FIRST):
            self._due[name] = now + min(SELDOM, max(OFTEN, (spent + left) / 10))
            text = f", {_text(task)}" if _text(task) else ""
            self.say(f"{name}: {_count(task)}, about {duration(left)} left{_bracketed(_speed(task))}{text}")


class _Column(ProgressColumn):
    def __init__(self, say: Callable[[Task], str]) -> None:
        super().__init__(Column(no_wrap=True))
        self.tell = say

    def render(self, task: Task) -> Text:
        return Text(self.tell(task))


def duration(seconds: float) -> str:
    """Seconds as rounded text, e.g. "42 s", "11 min", "2.5 h"."""
    minutes, hours = seconds / 60, seconds / 3600
    return f"{seconds:.0f} s" if minutes < 2 else f"{minutes:.0f} min" if hours < 2 else f"{hours:.1f} h"


def time_left(task: Task) -> float | None:
    """Seconds left. None before the second step, because the first includes start-up."""
    return task.fields.get("left", task.time_remaining)


def _clock(seconds: float | None) -> str:
    if seconds is None:
        return "-:--"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes // 60}:{minutes % 60:02d}:{rest:02d}" if minutes >= 60 else f"{minutes}:{rest:02d}"


def _count(task: Task) -> str:
    if task.total is None:
        return ""
    return f"{task.completed:,.0f}/{task.total:,.0f} {task.fields.get('unit', '')}".rstrip()


def _speed(task: Task) -> str:
    rate = task.fields.get("rate", task.fields.get("unit"))
    measured = (task.finished_speed or task.speed or 0) * task.fields.get("scale", 1)
    speed = task.fields.get("speed", measured)
    if not rate or not speed or task.total is None:
        return ""
    return f"{speed:,.0f} {rate}/s" if speed >= 10 else f"{speed:.1f} {rate}/s"


def _bracketed(text: str) -> str:
    return f" ({text})" if text else ""


def _text(task: Task) -> str:
    return task.fields.get("text", "")


@contextmanager
def shown(console: Console | None = None, *, quiet: bool = False, **options: Any) -> Iterator[Bars | None]:
    """Show all ``work`` inside this ``with`` block on ``console`` (default: stdout), or nothing if ``quiet``.

    A nested ``shown`` uses the display of the outer one.
    """
    if quiet:
        yield None
    elif _shown:
        yield _shown[-1]
    else:
        with Bars(console, **options) as bars:
            _shown.append(bars)
            try:
                yield bars
            finally:
                _shown.remove(bars)


@contextmanager
def work(
    what: str, total: int | None = None, unit: str = "", *, announce: bool = True
) -> Iterator[Callable[..., None]]:
    """Show one piece of work of ``total`` units; yields a function to call with the number of finished ones.

    ``announce``: print a line at the start in a pipe or a file.
    """
    if not _shown:
        yield lambda num=1: None
        return
    bars = _shown[-1]
    if announce and not bars.live_bars and what not in {task.description for task in bars.tasks}:
        bars.say(f"{what} ..." if total is None else f"{what}: {total:,} {unit}")
    task = bars.add_task(what, total=total, unit=unit)
    try:
        yield lambda num=1: bars.update(task, advance=num)
    finally:
        bars.end(task, always=False)


def tick(unit: str) -> None:
    """Count one more ``unit`` for the innermost ``work`` with that unit, if there is one."""
    for bars in _shown[-1:]:
        counting = [task.id for task in bars.tasks if task.fields.get("unit") == unit]
        for task in counting[-1:]:
            bars.update(task, advance=1)
