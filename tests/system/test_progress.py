"""What long work says of itself: bars with named columns on a terminal, a few plain lines in a pipe, nothing unasked."""

from __future__ import annotations

import io
import json
from pathlib import Path

import pytest
from rich.console import Console

from mvitac.system.progress import duration, shown, tick, work
from mvitac.training.log import in_a_bar, last_line


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


def pipe() -> Console:
    return Console(file=io.StringIO(), force_terminal=False, width=80)


def lines(console: Console) -> list[str]:
    return console.file.getvalue().splitlines()  # type: ignore[attr-defined]


def test_a_pipe_is_told_the_time_left_after_the_first_measured_steps() -> None:
    """The first step, which starts everything, takes 10 times as long as the others and is not measured."""
    clock, console = Clock(), pipe()
    with shown(console, get_time=clock) as bars:
        assert bars is not None
        bar = bars.add_task("pre-training", total=101, unit="steps", rate="pairs", scale=64)
        for done in range(1, 102):
            clock.now += 20 if done == 1 else 2
            bars.update(bar, completed=done, text="loss 3.21")
        bars.end(bar)
    said = lines(console)
    assert said[0] == "pre-training: 2/101 steps, about 3 min left (32 pairs/s), loss 3.21"  # at 22 seconds
    assert said[-1] == "pre-training: 101/101 steps in 4 min (32 pairs/s)"
    assert 8 <= len(said) <= 12  # about every tenth of the time


def test_what_is_done_at_once_is_not_told() -> None:
    clock, console = Clock(), pipe()
    with shown(console, get_time=clock), work("packing", 100, "items", announce=False) as advance:
        for _ in range(100):
            clock.now += 0.01
            advance()
    assert lines(console) == []


def test_work_says_what_it_is_and_tick_counts_the_innermost() -> None:
    clock, console = Clock(), pipe()
    with shown(console, get_time=clock):
        with work("drawing"):
            pass
        with work("fitting probes", 30, "probes"), work("reading features", 6000, "images") as advance:
            for _ in range(2):
                clock.now += 6
                tick("probes")
            advance(6000)
    assert lines(console) == [
        "drawing ...",
        "fitting probes: 30 probes",
        "reading features: 6,000 images",
        "fitting probes: 2/30 probes, about 3 min left (0.2 probes/s)",
    ]


def test_a_terminal_sees_bars_with_named_columns_in_80_columns() -> None:
    clock = Clock()
    console = Console(file=io.StringIO(), force_terminal=True, force_interactive=True, width=80, legacy_windows=False)
    with shown(console, get_time=clock, auto_refresh=False) as bars:
        assert bars is not None
        many = {"unit": "steps", "rate": "pairs", "scale": 64, "text": "loss 3.21"}
        bar = bars.add_task("pre-training", total=1150, **many)
        for done in (1, 2, 3):
            clock.now += 2
            bars.update(bar, completed=done)
        drawn = Console(file=io.StringIO(), width=80)
        drawn.print(bars.get_renderable())
    for word in ("pre-training", "3/1,150 steps", "elapsed 0:06", "left 38:14", "32 pairs/s", "loss 3.21"):
        assert word in lines(drawn)[0], word


def test_nothing_is_shown_unasked(capsys: pytest.CaptureFixture[str]) -> None:
    with work("drawing", 2, "sections") as advance:
        advance()
        tick("probes")
    with shown(quiet=True) as bars, work("drawing"):
        assert bars is None
    assert capsys.readouterr() == ("", "")


def test_one_display_inside_another_joins_it() -> None:
    console, other = pipe(), pipe()
    with shown(console), shown(other), work("drawing"):
        pass
    with shown(other), work("probing"):
        pass
    assert (lines(console), lines(other)) == (["drawing ..."], ["probing ..."])


def test_a_run_in_another_process_is_told_by_its_log(tmp_path: Path) -> None:
    unknown = {"completed": 0, "left": None, "speed": None}
    assert in_a_bar(last_line(tmp_path), 100, 16) == unknown
    line = {"step": 20, "loss": 3.456, "pairs_per_s": 32.0}
    (tmp_path / "log.jsonl").write_text(json.dumps(line) + "\n")
    expected = {"completed": 20, "left": 40.0, "speed": 32.0, "text": "loss 3.46"}
    assert in_a_bar(last_line(tmp_path), 100, 16) == expected


@pytest.mark.parametrize(("seconds", "said"), [(3.4, "3 s"), (119, "119 s"), (660, "11 min"), (9000, "2.5 h")])
def test_durations_in_words(seconds: float, said: str) -> None:
    assert duration(seconds) == said
