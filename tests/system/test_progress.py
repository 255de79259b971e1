"""What long work says of itself: bars with the time left on a terminal, a line now and then in a pipe, nothing unasked."""

import io
import sys

import pytest

from mvitac.system import progress
from mvitac.system.progress import duration, say, shown, tick, work


@pytest.mark.parametrize("on_terminal", [True, False])
def test_bars_tell_the_time_left_and_tick_counts_the_innermost(
    on_terminal: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    stream, now = io.StringIO(), [0.0]
    monkeypatch.setattr(stream, "isatty", lambda: on_terminal)
    monkeypatch.setattr(sys, "stderr", stream)
    monkeypatch.setattr("tqdm.std.time", lambda: now[0])
    with shown(), work("probing", 30, "probes"), work("pre-training", 100, "steps", done=10) as advance:
        for _ in range(8):
            now[0] += 20
            tick("probes")
            advance(1, "loss 3.21")
    text = stream.getvalue()
    for words in ("pre-training", "18/100", "<27:20", "20.00s/ steps", "loss 3.21", "probing", "8/30"):
        assert words in text, (words, text)
    assert ("\x1b[" in text) == on_terminal  # a file gets no cursor movements


def test_what_is_done_at_once_is_not_told(capsys: pytest.CaptureFixture[str]) -> None:
    with shown(), work("packing", 100, "items") as advance:
        advance(100)
    assert capsys.readouterr() == ("", "")


def test_nothing_is_shown_unasked(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress, "_Bar", None)  # calling it would raise
    with work("drawing", 2, "sections") as advance, shown(quiet=True), work("drawing"):
        advance()
        tick("probes")
        say("drawn")
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize(("seconds", "said"), [(3.4, "3 s"), (119, "119 s"), (660, "11 min"), (9000, "2.5 h")])
def test_durations_in_words(seconds: float, said: str) -> None:
    assert duration(seconds) == said
