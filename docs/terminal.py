"""What a command shows in a terminal, as PNG: how the docs' pictures of terminals are made.

    python docs/terminal.py [--at SECONDS] OUT.png COMMAND ... [-- COMMAND ...]

The commands run one after the other in a pseudo-terminal 96 columns wide; ``--at`` takes the picture so long after the
first output of the last one, then ends it. Needs Linux and chromium.
"""

import argparse
import fcntl
import itertools
import os
import pty
import re
import select
import shlex
import signal
import struct
import subprocess
import tempfile
import termios
import time
from pathlib import Path

from PIL import Image
from rich.console import Console
from rich.text import Text

WIDTH = 96
STEP = re.compile(r"\x1b\[[0-9;?]*[A-Za-ln-z]|\r\n|\r|\n")
"""What moves the cursor; colours (which end in m) belong to the text."""


def screen(output: str) -> list[str]:
    """The lines a terminal shows after ``output``: of what moves its cursor, what rich's ``Live`` uses."""
    lines, row, start = [""], 0, 0
    for step in [*STEP.finditer(output), None]:
        lines[row] += output[start : step.start() if step else len(output)]
        if step is None:
            break
        start, code = step.end(), step.group()
        if code.endswith("\n"):
            row += 1
            lines += [""] * (row == len(lines))
        elif code.endswith("A"):
            row -= int(code[2:-1] or 1)
        elif code.endswith("K") or code == "\r":
            lines[row] = ""
    while lines and not lines[-1].strip():
        lines.pop()
    return lines


def run(command: list[str], at: float | None) -> list[str]:
    """The screen when ``command`` has ended, or ``at`` seconds after its first output."""
    leader, follower = pty.openpty()
    fcntl.ioctl(follower, termios.TIOCSWINSZ, struct.pack("HHHH", 60, WIDTH, 0, 0))
    given = {"stdin": follower, "stdout": follower, "stderr": follower}
    env = {**os.environ, "TERM": "xterm-256color", "COLUMNS": str(WIDTH), "COLORTERM": "truecolor"}
    process = subprocess.Popen(command, **given, env=env, start_new_session=True)
    os.close(follower)
    output, first = b"", None
    while first is None or at is None or time.monotonic() < first + at:
        if select.select([leader], [], [], 0.05)[0]:
            try:
                output += os.read(leader, 1 << 16)
            except OSError:  # the command has ended
                break
            first = first or time.monotonic()
    shown = screen(output.decode())
    if process.poll() is None and at is not None:
        process.send_signal(signal.SIGINT)
    os.close(leader)
    process.wait()
    return shown


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--at", type=float, help="seconds after its first output at which the last command is shown")
    parser.add_argument("commands", nargs=argparse.REMAINDER)
    options = parser.parse_args()
    console = Console(record=True, width=WIDTH, file=open(os.devnull, "w"))  # noqa: SIM115
    commands = [list(part) for last, part in itertools.groupby(options.commands, "--".__eq__) if not last]
    for number, command in enumerate(commands, 1):
        console.print(Text(f"$ {shlex.join(command)}", style="bold"))
        for line in run(command, options.at if number == len(commands) else None):
            console.print(Text.from_ansi(line))
    svg = re.sub(r"@font-face \{.*?\}", "", console.export_svg(title="", font_aspect_ratio=0.6), flags=re.S)
    width, height = (int(float(x)) for x in re.findall(r'viewBox="0 0 ([\d.]+) ([\d.]+)"', svg)[0])
    with tempfile.TemporaryDirectory() as folder:
        page = Path(folder) / "page.html"
        page.write_text(f"<style>body{{margin:0}}svg{{display:block}}</style><meta charset=utf-8>{svg}")
        flags = ["--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", f"--user-data-dir={folder}/p"]
        size = f"--window-size={width},{height}"
        chromium = ["chromium", *flags, size, f"--screenshot={options.out.resolve()}", page.as_uri()]
        subprocess.run(chromium, check=True, capture_output=True)
    with Image.open(options.out) as picture:
        picture.convert("RGB").quantize(32).save(options.out, optimize=True)


if __name__ == "__main__":
    main()
