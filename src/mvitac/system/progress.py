"""How far long work has come, and how long it will take, by what was measured of it.

``shown`` opens a display and ``work`` adds a line to it, from any depth of calls and any thread. Without ``shown``, as when
a function is called from Python, nothing is printed. A terminal or a notebook sees bars whose columns are named. A pipe or
a file gets plain lines: what is done, after the first measured steps the time left, then about every tenth of the time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, Task, TaskID
from rich.table import Column
from rich.text import Text

WIDE = 120
"""Columns of a terminal in which there is room for every loss and a long bar."""
FIRST, OFTEN, SELDOM = 5.0, 10.0, 300.0
"""Seconds before the first plain line, and the least and the most between two."""
_shown: list[Bars] = []


class Bars(Progress):
    """rich's Progress with named columns, or with plain lines where bars cannot move.

    Fields of a task: ``unit``, what is counted; ``rate`` and ``scale``, the unit of the speed and how many of them one step
    is (default: the counted unit); ``text``, further words; ``left`` and ``speed``, seconds left and the speed where they
    are known otherwise than by this task's own updates; ``silent``, no plain lines.
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
        """A plain line, above the bars where there are some."""
        self.console.print(text, soft_wrap=True, highlight=False, markup=False)

    def end(self, task_id: TaskID, *, always: bool = True) -> None:
        """Take a task's bar away, and say what was done; of short work only if ``always``."""
        task = self._tasks[task_id]
        self.remove_task(task_id)
        told = self._due.pop(task.description, None) is not None
        if task.finished and (always or told):
            self.say(_summary(task))

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
    """Seconds in words, as exact as one would say them."""
    minutes, hours = seconds / 60, seconds / 3600
    return f"{seconds:.0f} s" if minutes < 2 else f"{minutes:.0f} min" if hours < 2 else f"{hours:.1f} h"


def time_left(task: Task) -> float | None:
    """Seconds that ``task`` will still take; None before its second step is done, as the first one starts everything."""
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


def _summary(task: Task) -> str:
    spent = duration(task.finished_time or 0)
    return f"{task.description}: {_count(task)} in {spent}{_bracketed(_speed(task))}"


def _text(task: Task) -> str:
    return task.fields.get("text", "")


@contextmanager
def shown(console: Console | None = None, *, quiet: bool = False, **options: Any) -> Iterator[Bars | None]:
    """Show the ``work`` that is done in this ``with`` on ``console`` (default: stdout); nothing if ``quiet``.

    Inside another ``shown`` the bars join that one's.
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
    """Some work, of ``total`` units where they can be counted; the function it gives is told of each that is done.

    Without ``announce`` a pipe or a file gets no line at its start.
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
    """One more ``unit`` is done, for the innermost ``work`` that counts them, if one does."""
    for bars in _shown[-1:]:
        counting = [task.id for task in bars.tasks if task.fields.get("unit") == unit]
        for task in counting[-1:]:
            bars.update(task, advance=1)
