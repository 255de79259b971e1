"""Text for a terminal. Labels and file names may be a stranger's: their control characters are printed as "?"."""

import contextlib
import re
import sys
import textwrap
from collections.abc import Iterator
from typing import Any

_CONTROL = re.compile("[\0-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")
"""All control characters but tab and newline; also those that reverse the direction of text."""


def plain(text: str) -> str:
    """``text`` with "?" for every character that a terminal would obey, such as the one that begins an escape sequence."""
    return _CONTROL.sub("?", text)


def wrapped(text: str, width: int = 80) -> str:
    """``text`` with lines longer than ``width`` broken between words or after a "|", and indented as they were."""

    def broken(line: str) -> str:
        indent = line[: len(line) - len(line.lstrip())]
        return textwrap.fill(
            line.replace("|", "| "), width, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False
        ).replace("| ", "|")

    return "\n".join(line if len(line) <= width else broken(line) for line in text.split("\n"))


class _PlainStream:
    """A stream that writes ``plain`` text. rich writes its own sequences to the stream behind it, after its own check."""

    def __init__(self, stream: Any) -> None:
        self.rich_proxied_file = stream  # rich's name for it

    def write(self, text: str) -> int:
        self.rich_proxied_file.write(plain(text))
        return len(text)

    def writelines(self, lines: Any) -> None:
        for line in lines:
            self.write(line)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.rich_proxied_file, name)


@contextlib.contextmanager
def plain_output() -> Iterator[None]:
    """Everything that is printed meanwhile is ``plain``."""
    before = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = _PlainStream(before[0]), _PlainStream(before[1])  # type: ignore[assignment]
    try:
        yield
    finally:
        sys.stdout, sys.stderr = before
