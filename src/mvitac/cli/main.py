"""The command line. `mvitac --help` imports nothing heavy; each command is imported when it is called.

A mistake of the user ends in one line on stderr and exit code 2, Ctrl-C in 130. A traceback is a bug of ours.
"""

import importlib
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from mvitac.shipped import with_names

HELP = (Path(__file__).parent / "help.txt").read_text(encoding="utf-8")

COMMANDS = {
    "demo": "demo:demo",
    "data simulate": "data:simulate",
    "data pack": "data:pack",
    "data info": "data:info",
    "data check": "data_check:check",
    "data show": "data:show",
    "pretrain": "pretrain:pretrain",
    "finetune": "finetune:finetune",
    "adapt": "finetune:adapt",
    "probe": "evaluate:probe",
    "compare": "compare:compare",
    "bench": "bench:bench",
    "bench board": "bench:board",
    "bench check": "bench:check",
    "ablate": "ablate:ablate",
    "report": "evaluate:report",
    "publish": "deploy:publish",
    "export": "deploy:export",
    "predict": "live:predict",
    "live": "live:live",
    "explore": "explore:explore",
    "embed": "search:embed",
    "find": "search:find",
}
"""Command -> module of this package:function, imported when called."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code."""
    if "OMP_WAIT_POLICY" not in os.environ:
        # Beside another busy program, threads that wait by spinning made a step take five times as long (docs/speed.md).
        os.environ.setdefault("GOMP_SPINCOUNT", "10000")
    arguments = list(sys.argv[1:] if argv is None else argv)
    try:
        return _run(arguments)
    except KeyboardInterrupt:
        return 130
    except (ValueError, OSError, MemoryError) as error:
        text = " ".join(str(error).split()) or type(error).__name__
        if arguments[0] == "data":  # here the options of a dataset are --path, not --data.path as for pretrain
            text = text.replace("--data.", "--")
        print(f"mvitac: error: {text}", file=sys.stderr)
        return 2
    except Exception as error:
        if type(error).__name__ != "Interrupted":  # training.loop's, which is not imported for every command
            raise
        print(f"mvitac: {error}", file=sys.stderr)
        return 130


def _run(arguments: list[str]) -> int:
    """Run the command that ``arguments`` name, and return its exit code."""
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        print(HELP, end="")
        return 0
    if arguments[0] == "data" and (len(arguments) == 1 or arguments[1] in ("-h", "--help")):
        lines = [line for line in HELP.splitlines() if line.startswith("  data ")]
        print("usage: mvitac data COMMAND [OPTIONS]     (--help after a command explains it)", "", *lines, sep="\n")
        return 0
    if arguments[0] == "--version":
        from mvitac import __version__

        print(__version__)
        return 0
    name, rest = arguments[0], arguments[1:]
    if name == "data" or (rest and f"{name} {rest[0]}" in COMMANDS):
        name, rest = f"{name} {rest[0]}", rest[1:]
    if name not in COMMANDS:
        from mvitac.registry import unknown

        raise unknown("command", name, COMMANDS)
    text = help_file(name)
    if rest in (["--help"], ["-h"]) and text.exists():
        print(text.read_text(encoding="utf-8"), end="")
        return 0
    module, function = COMMANDS[name].split(":")
    return getattr(importlib.import_module(f"mvitac.cli.{module}"), function)(with_names(rest)) or 0


def help_file(command: str) -> Path:
    """The stored help of ``command``, 80 columns wide: it is printed at once, without importing torch.

    The files are what each command says of itself (``tests/cli/test_help.py`` compares and writes them).
    """
    return Path(__file__).parent / "help" / f"{command.replace(' ', '-')}.txt"
