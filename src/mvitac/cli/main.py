"""The command line. `mvitac --help` imports nothing heavy; each command is imported when it is called.

A mistake of the user ends in one line on stderr and exit code 2, Ctrl-C in 130. A traceback is a bug of ours.
"""

import importlib
import os
import re
import shlex
import sys
from collections.abc import Sequence
from contextlib import suppress
from fnmatch import fnmatch
from pathlib import Path

from mvitac import __version__
from mvitac.registry import check_known, unknown

HELP = (Path(__file__).parent / "help.txt").read_text(encoding="utf-8")

COMMANDS = {
    "demo": "demo:demo",
    "data pack": "data:pack",
    "data info": "data:info",
    "data check": "data_check:check",
    "pretrain": "pretrain:pretrain",
    "finetune": "finetune:finetune",
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
    "embed": "search:embed",
    "find": "search:find",
}
"""Command -> module of this package:function, imported when called."""

HEAVY = ("demo", "pretrain", "finetune", "compare", "bench")
"""Commands whose options need torch. The others import it once their options are known to be right."""


def main(argv: Sequence[str] | None = None) -> int:
    if "OMP_WAIT_POLICY" not in os.environ:
        # Beside another busy program, threads that wait by spinning made a step take five times as long (docs/speed.md).
        os.environ.setdefault("GOMP_SPINCOUNT", "10000")
    words = sys.argv[1:] if argv is None else argv
    home = f"={Path.home()}/"  # the shell does not read ~ in --out=~/x
    arguments = [word.replace("=~/", home, 1) if word.startswith("--") else word for word in words]
    try:
        return _run(arguments)
    except KeyboardInterrupt:
        print(f"mvitac: stopped{_continued(arguments)}", file=sys.stderr)
        return 130
    except BrokenPipeError:  # whoever read the output has enough, as in `mvitac live ... | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except (ValueError, OSError, MemoryError) as error:
        text = " ".join(str(error).split()) or type(error).__name__
        text = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)  # a terminal would obey it
        # Here the options of a dataset are --path, not --data.path as for pretrain.
        if arguments[0] not in HEAVY and "Unrecognized" not in text:
            where = "" if arguments[0] == "data" else " of mvitac data pack"
            text = re.sub(r"--data\.([\w-]+)", rf"--\1{where}", text)
        print(f"mvitac: error: {text}", file=sys.stderr)
        return 2
    except Exception as error:
        if type(error).__name__ != "Interrupted":  # training.loop's, which is not imported for every command
            raise
        print(f"mvitac: {str(error).partition(';')[0]}{_continued(arguments)}", file=sys.stderr)
        return 130


def _continued(arguments: list[str]) -> str:
    """The command that goes on where the one of ``arguments`` was stopped; "" if nothing of it is kept."""
    if arguments[0] not in HEAVY:
        return ""
    resume = "--resume" in help_file(arguments[0]).read_text() and "--resume" not in arguments
    return f"; continue: {shlex.join(['mvitac', *arguments, *['--resume'] * resume])}"


def _run(arguments: list[str]) -> int:
    asked = arguments[1:2] if arguments[:1] == ["data"] else arguments[:1]
    if asked in ([], ["-h"], ["--help"], ["help"]):
        print(HELP, end="")
        return 0
    if arguments[0] == "--version":
        print(__version__)
        return 0
    try:
        Path.cwd()
    except FileNotFoundError:  # torch would end the program without a word
        raise ValueError("the current folder was deleted: change to another") from None
    name, rest = arguments[0], arguments[1:]
    if name == "data" or (rest and f"{name} {rest[0]}" in COMMANDS):
        name, rest = f"{name} {rest[0]}", rest[1:]
    check_known("command", [name], COMMANDS)
    text = help_file(name)
    if rest in (["--help"], ["-h"]) and text.exists():
        print(text.read_text(encoding="utf-8"), end="")
        return 0
    if not {"-h", "--help"} & set(rest):
        _check_once(rest)
        _check_choices(rest, text)
        _check_outputs(rest)
        if name in HEAVY:
            from mvitac.cli.options import loading

            loading()
    module, function = COMMANDS[name].split(":")
    return getattr(importlib.import_module(f"mvitac.cli.{module}"), function)(rest) or 0


def _check_once(words: Sequence[str]) -> None:
    """ValueError for an option that is given twice, also as --no-OPTION: only the last one would count."""
    names = [word.partition("=")[0].replace("_", "-") for word in words if word.startswith("--")]
    plain = [re.sub(r"(^--|\.)no-", r"\1", name) for name in names]
    if twice := [name for name, one in zip(names, plain, strict=True) if plain.count(one) > 1]:
        raise ValueError(f"{twice[0]} is given twice: give it once, with all its values")


def _check_choices(rest: Sequence[str], text: Path) -> None:
    """ValueError for a choice (--recipe NAME) that the stored help does not list, before torch is imported."""
    for line in text.read_text().splitlines() if text.exists() else ():
        known = re.match(r" *(--\w+) ([\w.-]+(?:\|[\w.-]+)+) ", line)
        if not known or known[1] not in rest:
            continue
        option, choices = known[1], known[2].split("|")
        if (value := next(iter(rest[rest.index(option) + 1 :]), choices[0])) in choices:
            continue
        if Path(value).exists():
            if option == "--data" and (twice := {word.partition("=")[0] for word in rest} & {"--data.path", "--path"}):
                raise ValueError(f"--data {value} is a path, and {min(twice)} gives another: give one of them")
            continue
        if option in ("--data", "--method"):  # one's own are in no stored help
            base = importlib.import_module("mvitac.datasets.base" if option == "--data" else "mvitac.methods.base")
            choices = [*(base.DatasetConfig if option == "--data" else base.MethodConfig).choices]
        if value not in choices:
            raise unknown({"--data": "dataset"}.get(option, option[2:]), value, choices)


def _check_outputs(words: Sequence[str]) -> None:
    """ValueError for one place of two outputs, and for an output over what the command may read.

    That is an input, a file in a folder that is one or that a run was trained on, one that a table names, and what is read
    beside a video (docs/datasets.md).
    """
    places = [part for word in words for part in word.split("=")]
    outputs = {i + 1: word for i, word in enumerate(places[:-1]) if word in ("--out", "--json", "--sheet", "--record")}
    others = [re.sub(r"(@[\d.]+)?(#.*)?$", "", place) for i, place in enumerate(places) if i not in outputs]
    parts = [*others, *(part for place in others for part in re.split("[,:]", place))]
    beside = [Path(p).name.replace("{}", "*") if "{}" in p else f"{Path(p).stem}_timestamps.*" for p in parts]
    seen: set[Path] = set()
    for i, option in outputs.items():
        file = Path(os.path.realpath(places[i]))
        if any(one == file or one in file.parents or file in one.parents for one in seen):
            raise ValueError(f"{option} {places[i]} is the place of another output, or inside it: give another")
        seen.add(file)
        if not file.is_file():
            continue
        name = rf"(?<![\w.-]){re.escape(file.name)}(?![\w.-])"
        texts = [_names(Path(part)) for part in parts]
        named = [Path(name) for text in texts for name in re.findall(r'"(?:path|pack)": "([^"]+)"', text)]
        inputs = [Path(os.path.realpath(place)) for place in (*parts, *named) if os.path.exists(place)]
        read = {file, *file.parents} & {*inputs} or any(os.path.samefile(file, place) for place in inputs)
        if read or any(re.search(name, text) for text in texts) or any(fnmatch(file.name, each) for each in beside):
            raise ValueError(f"{option} {places[i]} may be what the command reads: choose another place")


def _names(place: Path) -> str:
    """The text of a table or of a run's configuration, which may name data; "" of other places."""
    place = place / "run.json" if (place / "run.json").is_file() else place
    if place.suffix in (".csv", ".jsonl", ".json") and place.is_file():
        return place.read_text(errors="replace")
    if place.suffix == ".parquet" and (place := place.absolute()).is_file():
        import pyarrow.parquet as pq

        with suppress(ValueError, OSError):  # a damaged file, of which the command itself says so
            schema = pq.read_schema(place)
            texts = pq.read_table(place, columns=[field.name for field in schema if str(field.type) == "string"])
            return f"{texts.to_pydict()} {(schema.metadata or {}).values()}"
    return ""


def help_file(command: str) -> Path:
    """The stored help of ``command``, 80 columns wide: it is printed at once, without importing torch.

    The files are what each command says of itself (``tests/cli/test_help.py`` compares and writes them).
    """
    return Path(__file__).parent / "help" / f"{command.replace(' ', '-')}.txt"
