"""Options of a command line: tyro's, with every mistake of a user reported in one line."""

import argparse
import contextlib
import dataclasses
import inspect
import io
import itertools
import json
import os
import re
import sys
import textwrap
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TextIO, TypeVar
from unittest.mock import patch

import tyro

from mvitac.shipped import named
from mvitac.system.files import check_place, naming, write_json

T = TypeVar("T")
STDOUT = Path("-")  # the --json FILE that means stdout


def parse(
    kind: Callable[..., T] | type[T], argv: Sequence[str], prog: str, *, default: Any = None, description: str = ""
) -> T:
    """Parse ``argv``, the words after the command's name ``prog``, with tyro; its boxed errors become one ValueError.

    ``kind``: dataclass of the options; the docstring under each field is its help text, and ``default`` an instance with
    other defaults. ``description``: text of ``--help`` above the options, instead of the docstring of ``kind``.
    """
    argv = _for_both(argv)
    options: dict[str, Any] = {"args": list(argv), "prog": f"mvitac {prog}"}
    options["description"] = inspect.cleandoc(description) or None  # None: the docstring
    if default is not None:
        options["default"] = default
    boxed, shown = io.StringIO(), io.StringIO()
    try:
        with contextlib.redirect_stderr(boxed):
            if {"-h", "--help"} & set(argv):
                # A flag is shown in the one form that changes something; --x and --no-x are both accepted.
                with _joined_lines(), contextlib.redirect_stdout(shown):
                    tyro.cli(kind, **options, config=(tyro.conf.FlagCreatePairsOff, tyro.conf.SuppressFixed))  # type: ignore[arg-type]
            with patch.dict(os.environ, COLUMNS="10000"):  # the lines of an error must not be wrapped
                return _with_base(tyro.cli(kind, **options))  # type: ignore[arg-type]
    except SystemExit as exit_:
        if not exit_.code:  # what has no default, or may be left out, need not be said
            text = re.sub(r"\{None\}\|(\S+ )( +\S)", r"\1       \2", shown.getvalue())
            text = re.sub(r"\{None\}\||\s+\(default:\s+(None|False)?\)", "", text)
            text = re.sub(r"\(default:\s+True\)", "(default: on)", text)  # a flag's text is that of its other form
            for line in text.split("\n")[:-1]:  # but for a list of choices, which ``_check_choices`` reads
                print(line if line[:1] == " " else textwrap.fill(line, 80))
            raise
        raise ValueError(_one_line(boxed.getvalue(), prog)) from None


def _with_base(options: T) -> T:
    """``options`` with the folder of the shipped model where a model is called ``base``."""
    given = {name: value for name in ("model", "models", "run", "runs") if (value := getattr(options, name, None))}
    found = {n: tuple(map(named, v)) if isinstance(v, tuple) else named(v) for n, v in given.items()}
    return dataclasses.replace(options, **found)  # type: ignore[type-var]


def _for_both(argv: Sequence[str]) -> list[str]:
    """``argv`` with ``--encoder.NAME VALUE`` as ``--encoder.vision.NAME VALUE --encoder.touch.NAME VALUE``."""
    found: list[str] = []
    for at, word in enumerate(argv):
        if short := re.fullmatch(r"--encoder\.((?!vision\.|touch\.).*)", word):
            values = itertools.takewhile(lambda other: not other.startswith("--"), argv[at + 1 :])
            found += [f"--encoder.vision.{short[1]}", *values, f"--encoder.touch.{short[1]}"]
        else:
            found.append(word)
    return found


def _joined_lines() -> Any:
    """Let tyro wrap field docstrings itself: it keeps the line breaks of the source, and has no option for that."""
    from tyro import _docstrings

    read = _docstrings.get_field_docstring

    def joined(*arguments: Any) -> str | None:
        text = read(*arguments)
        return text and re.sub(r"(?<!\n)\n(?!\n)", " ", text)

    return patch.object(_docstrings, "get_field_docstring", joined)


def selectors(argv: list[str], names: Sequence[str]) -> tuple[dict[str, str], list[str]]:
    """Take the options ``names`` (each with one value) out of ``argv``; return their values and the other words."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    for name in names:
        parser.add_argument(name, dest=name)
    try:
        found, rest = parser.parse_known_args(argv)
    except argparse.ArgumentError as error:
        raise ValueError(f"{error.argument_name}: expected a value after it") from None
    return {name: value for name, value in vars(found).items() if value is not None}, rest


def loading() -> None:
    """Say at once that work has begun, before torch is imported, which takes seconds."""
    if "torch" not in sys.modules and sys.stderr.isatty():
        print("mvitac: loading PyTorch ...", file=sys.stderr, flush=True)


def check_models(*models: str | Path) -> None:
    """ValueError for the first of ``models`` that is not here and no name on the Hub or of an encoder (external:...)."""
    for model in models:
        if ":" not in str(model) and not Path(model).exists() and Path(model).parent.is_dir():
            raise ValueError(f"no trained model at {model}")


def asks_help(argv: Sequence[str]) -> bool:
    return bool({"-h", "--help"} & set(argv))


def check_json(path: Path | None, option: str = "--json") -> None:
    """ValueError if the file of ``option`` cannot be written; called before the work begins."""
    if path and path != STDOUT:
        check_place(path)
        if path.is_dir():
            raise ValueError(f"{option} {path} is a folder: give another place, the name of a file")
        if option == "--sheet" and path.suffix.lower() != ".png":
            raise ValueError(f"--sheet {path}: give the name of a .png file")


def printed_to(json_file: Path | None) -> TextIO:
    """Where a command prints: stdout, or stderr if its JSON goes to stdout."""
    return sys.stderr if json_file == STDOUT else sys.stdout


def save_json(path: Path | None, value: Any, *, sealed: bool = False) -> None:
    """Write ``value`` to the file of a ``--json`` option, if it was given, and say so."""
    if path == STDOUT:
        with naming(Path("stdout")):
            print(json.dumps(value, indent=1, allow_nan=False), flush=True)
    elif path:
        write_json(path, value, sealed=sealed)
        print(f"written: {path}")


def _one_line(boxed: str, prog: str) -> str:
    """tyro's error without its title, frame and the repeated help of the option, which names its option or field."""
    text = re.sub(r"\x1b\[[0-9;]*m", "", boxed)
    lines = [line.strip(" │|") for line in text.splitlines()[1:] if not re.match(r"\s*(╰|[│|]?\s*[-─]{3,})", line)]
    text = re.split(r" (?:Argument helptext:|For full helptext)", " ".join(line for line in lines if line))[0]
    text = re.sub(r"^Error parsing \w+: ", "", text)  # a class of ours
    return f"{text} (see mvitac {prog} --help)"
