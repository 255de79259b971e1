"""Labels of a stranger reach the terminal as text: no escape sequence of theirs, all of our own."""

from __future__ import annotations

import io
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from rich.table import Table
from rich.text import Text

import mvitac
from mvitac.cli.main import main
from mvitac.data.pack import Pack
from mvitac.system.console import Console
from mvitac.system.progress import shown, work
from mvitac.system.terminal import plain_output, wrapped
from support.forged_packs import described

EVIL = "\x1b]0;owned\x07\x1b[2J\x9b1A\rrm"
SPOILT = re.compile("[\0-\x08\x0b-\x1f\x7f-\x9f]")


def test_consoles_print_escapes_of_labels_as_question_marks() -> None:
    file = io.StringIO()
    table = Table(title=EVIL)
    table.add_column(EVIL)
    table.add_row(EVIL)
    console = Console(file=file, markup=False, force_terminal=True, width=80)
    console.print(table)
    console.print(EVIL, Text(EVIL, style="red"))
    console.show_cursor(False)
    text = file.getvalue()
    assert "?]0;owned" in text and "\x1b[31m" in text and "\x1b[?25l" in text  # colour and cursor are ours
    assert not SPOILT.search(re.sub(r"\x1b\[(\d+;?)*m|\x1b\[\?25l", "", text))
    assert len({len(line) for line in text.splitlines()[1:6]}) == 1 or "┃" in text  # columns stay aligned


def test_bars_keep_their_own_escapes_beside_printed_labels(monkeypatch: pytest.MonkeyPatch) -> None:
    """rich puts a proxy before ours while bars are shown, and its bars must still reach the terminal itself."""
    terminal = io.StringIO()
    monkeypatch.setattr(terminal, "isatty", lambda: True)
    monkeypatch.setattr(sys, "stdout", terminal)
    monkeypatch.setenv("TERM", "xterm")
    with plain_output(), shown(), work("reading", 2, "images") as tick:
        tick()
        print(EVIL)
    text = terminal.getvalue()
    assert "reading" in text and "\x1b[2K" in text and "?[2K" not in text, text
    assert "rm" in text and not SPOILT.search(re.sub(r"\x1b\[(\d+;?)*[mA]|\x1b\[(2K|\?25[lh])|\r", "", text))


@pytest.mark.parametrize("on_terminal", [True, False])
def test_long_lines_break_between_words_on_a_terminal_only(on_terminal: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    text, streams = "missing: " + 12 * "column/of/a/table ", [io.StringIO(), io.StringIO()]
    for name, stream in zip(("stdout", "stderr"), streams, strict=True):
        monkeypatch.setattr(stream, "isatty", lambda: on_terminal)
        monkeypatch.setattr(sys, name, stream)
    monkeypatch.setenv("COLUMNS", "50")
    monkeypatch.setenv("TERM", "xterm")
    Console(highlight=False, width=50).print(text.strip(), soft_wrap=True)
    assert main(["data", "info", text]) == 2
    for stream in streams:
        lines = stream.getvalue().splitlines()
        assert (len(lines) > 4 and max(map(len, lines)) <= 50) if on_terminal else len(lines) == 1, lines
        assert " ".join(line.strip() for line in lines).count("column/of/a/table") == 12


def test_choices_break_after_a_bar() -> None:
    text = "usage:\n  --data " + "|".join(["calandra", "folder", "physiclear"] * 4)
    lines = wrapped(text, 40).splitlines()
    assert lines[1].endswith("|") and max(map(len, lines)) <= 40 and all(line[:2] == "  " for line in lines[1:])
    assert "".join(wrapped(text, 40).split()) == "".join(text.split())


@pytest.mark.parametrize("command", [["data", "info", "{pack}"], ["data", "info", EVIL]])
def test_no_command_prints_an_escape_of_a_label(
    pack: Pack, tmp_path: Path, capsys: pytest.CaptureFixture[str], command: list[str]
) -> None:
    copy = shutil.copytree(pack.path, tmp_path / "pack")
    meta = json.loads((copy / "pack.json").read_text())["spec"]
    tasks = [{**task, "classes": [EVIL + c for c in task["classes"]]} for task in meta["tasks"]]
    for name, value in (("tasks", tasks), ("notes", [EVIL]), ("source", EVIL), ("licence", EVIL), ("name", EVIL)):
        described("spec", name, value=value)(copy)
    main([word.replace("{pack}", str(copy)) for word in command])
    found = capsys.readouterr()
    assert "?]0;owned?" in found.out + found.err
    assert not SPOILT.search(found.out + found.err)


def test_every_console_of_the_package_is_this_one() -> None:
    source = Path(mvitac.__file__).parent
    others = [p for p in source.rglob("*.py") if re.search(r"rich\.console import .*\bConsole\b", p.read_text())]
    assert not others


def test_help_is_in_colour_on_a_terminal() -> None:
    code = (
        "import sys; sys.stdout.isatty = lambda: True; from mvitac.cli.main import main; main(['data', 'info', '-h'])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env={"FORCE_COLOR": "1", "PATH": "/usr/bin"}
    )
    assert "?[1m" not in done.stdout and "Folder of the pack" in done.stdout, done.stderr
