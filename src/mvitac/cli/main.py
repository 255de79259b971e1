"""The command line. `mvitac --help` imports nothing heavy; each command is imported when it is called.

A mistake of the user ends in one line on stderr and exit code 2, Ctrl-C in 130. A traceback is a bug of ours.
"""

import importlib
import os
import re
import sys
from collections.abc import Sequence
from pathlib import Path

HELP = (Path(__file__).parent / "help.txt").read_text(encoding="utf-8")

COMMANDS = {
    "demo": "demo:demo",
    "data simulate": "data:simulate",
    "data pack": "data:pack",
    "data info": "data:info",
    "data check": "data_check:check",
    "data sheet": "data:sheet",
    "data show": "data:show",
    "pretrain": "pretrain:pretrain",
    "finetune": "finetune:finetune",
    "adapt": "finetune:adapt",
    "probe": "evaluate:probe",
    "compare": "compare:compare",
    "bench": "bench:bench",
    "bench board": "bench:board",
    "bench check": "bench:check",
    "report": "evaluate:report",
    "publish": "deploy:publish",
    "export": "deploy:export",
    "live": "live:live",
    "explore": "explore:explore",
    "embed": "search:embed",
    "index": "search:index",
    "find": "search:find",
    "completion": "completion:completion",
}
"""Command -> module of this package:function, imported when called."""


LEAST_MEMORY = 1 << 30  # bytes of address space that any command needs
_NO_MEMORY = "(out of|can(no|')t allocate) memory|failed to map segment|can't start new thread|std::bad_alloc"
"""What torch, the loader of shared libraries and threads say when memory (``ulimit -v``) runs out."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code."""
    _wait_briefly()
    arguments = list(sys.argv[1:] if argv is None else argv)
    try:
        code = _run(arguments)
        sys.stdout.flush()
        return code
    except BrokenPipeError as error:
        if _reader_left():
            return 141  # the exit code that a shell gives for SIGPIPE
        _complain(f"error: {one_line(error)}")
        return 2
    except KeyboardInterrupt:
        return 130
    except (ValueError, OSError, MemoryError, RecursionError) as error:
        text = one_line(error)
        if arguments[0] == "data":  # here the options of a dataset are --path, not --data.path as for pretrain
            text = text.replace("--data.", "--")
        _complain(f"error: {text}")
        return 2
    except Exception as error:
        if type(error).__name__ == "Interrupted":
            _complain(str(error))
            return 130
        if isinstance(error, (RuntimeError, ImportError)) and re.search(_NO_MEMORY, str(error)):
            _complain(f"error: {one_line(MemoryError())}")
            return 2
        raise


def _complain(text: str) -> None:
    print(f"mvitac: {text}", file=sys.stderr)


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
    _check_once(rest)
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
    _check_memory()
    return getattr(importlib.import_module(f"mvitac.cli.{module}"), function)(rest) or 0


def help_file(command: str) -> Path:
    """The stored help of ``command``, 80 columns wide: it is printed at once, without importing torch.

    The files are what each command says of itself (``tests/cli/test_help.py`` compares and writes them).
    """
    return Path(__file__).parent / "help" / f"{command.replace(' ', '-')}.txt"


def _reader_left() -> bool:
    """Whether the reader of stdout has closed it (``mvitac ... | head``); if so, the rest goes to the null device."""
    import select

    out = select.poll()
    out.register(1, 0)
    left = any(event & select.POLLERR for _, event in out.poll(0))
    if left:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    return left


def _wait_briefly() -> None:
    """Let OpenMP threads spin for microseconds, not milliseconds, while they wait for each other.

    Beside another busy program the awaited thread may not be running: a step on two cores then took five times as long
    (docs/speed.md). libgomp reads the variable when torch loads it. OpenMP variables that the user set are kept.
    """
    if not {"OMP_WAIT_POLICY", "GOMP_SPINCOUNT"} & set(os.environ):
        os.environ["GOMP_SPINCOUNT"] = "10000"


def _check_memory() -> None:
    """ValueError if the shell allows too little address space; OpenBLAS would then try to allocate for ever."""
    try:
        import resource
    except ImportError:  # Windows
        return
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit != resource.RLIM_INFINITY and limit < LEAST_MEMORY:
        raise ValueError(
            f"{limit >> 20} MB of memory are allowed (ulimit -v), at least {LEAST_MEMORY >> 20} are needed: raise the limit"
        )


def _check_once(argv: Sequence[str]) -> None:
    """ValueError if an option is given twice, which is a mistake in a long command; tyro would take the last one."""
    names = [word.split("=")[0].replace("_", "-") for word in argv if word.startswith("--")]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"{name} is given twice: give it once")


def one_line(error: BaseException) -> str:
    """An error as one line; an error of the operating system gets the file's name and advice."""
    if isinstance(error, OSError) and error.strerror:
        advice = {
            28: "free some space or choose another --out",
            13: "check its permissions or choose another place",
            30: "choose another --out",
            36: "choose a shorter name",
        }
        hint = advice.get(error.errno or 0, "check the path")
        text = f"{error.filename or 'file'}: {error.strerror} ({hint})"
    elif isinstance(error, MemoryError):
        text = "not enough memory: use a smaller --batch-size, --augment.size or pack"
    elif isinstance(error, RecursionError):
        text = "a file that was read is nested too deeply: it is damaged"
    else:
        text = str(error) or type(error).__name__
    text = " ".join(text.split()).replace("\0", "\\x00")
    return text if len(text) <= 1200 else f"{text[:600]} ... {text[-600:]}"
