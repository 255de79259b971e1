"""Options of a command line: tyro's, with every slip of a user told in one line."""

import argparse
import contextlib
import io
import os
import re
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

T = TypeVar("T")


def parse(kind: Callable[..., T] | type[T], argv: Sequence[str], prog: str, *, default: Any = None) -> T:
    """tyro, with its boxed errors folded into the one line every command owes."""
    import tyro

    argv = [
        re.sub(r"^--(data\.)?(no-)?difference(?==|$)", r"--\1\2subtract-background", word) for word in argv
    ]  # old name
    if "-h" in argv or "--help" in argv:
        wide: Any = contextlib.nullcontext()
    else:
        wide = _columns("10000")  # no help will be shown, and an error's lines must not be wrapped
    boxed = io.StringIO()
    try:
        with contextlib.redirect_stderr(boxed), wide:
            options: dict[str, Any] = {} if default is None else {"default": default}
            return tyro.cli(kind, args=list(argv), prog=f"mvitac {prog}", **options)  # type: ignore[arg-type]
    except SystemExit as exit_:
        if not exit_.code:
            raise
        raise ValueError(_unboxed(boxed.getvalue(), prog)) from None


def short(argv: Sequence[str]) -> list[str]:
    """``argv`` with a dataset's options as its own commands have them (--root), where spelt as in pretrain (--data.root)."""
    return [f"--{word.removeprefix('--data.')}" if word.startswith("--data.") else word for word in argv]


@contextlib.contextmanager
def _columns(width: str) -> Iterator[None]:
    old = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = width
    try:
        yield
    finally:
        del os.environ["COLUMNS"]
        if old is not None:
            os.environ["COLUMNS"] = old


def _unboxed(text: str, prog: str) -> str:
    """What a boxed error of tyro says, in our words: `--batch-size: 'x' is not an int (see ... --help)`."""
    from mvitac.registry import unknown

    text = re.sub(r"\x1b\[[0-9;]*m", "", text)
    # A frame of ╭─ title ─╮ and rules of ─ in a terminal; a title, an empty line and rules of - where it is ASCII only.
    lines = [line.strip(" │|") for line in text.splitlines() if not re.match(r"\s*([╭╰├]|[│|]?\s*[-─]{3,})", line)]
    lines = [line for line in lines if line and not line.startswith("For full helptext")]
    if lines and lines[0] in (
        "Value error",
        "Missing argument",
        "Invalid choice",
        "Unrecognized options",
        "Required options",
    ):
        lines = lines[1:]
    see = f"(see mvitac {prog} --help)"
    whole = " ".join(lines)
    if found := re.match(r"Error parsing (?:run|data|session)?(?:\.[\w.]+)?: (.*)", whole):
        return found[1]  # a config's own check, which names its field and what is allowed
    if found := re.match(r"invalid choice '(.*)' for argument '(\S+)'\. Expected one of (\(.*\))", whole):
        return f"{found[2]}: {unknown('choice', found[1], re.findall(chr(39) + '(.*?)' + chr(39), found[3]))}"
    if found := re.match(r"Missing value for argument '(\S+)'\. Expected (\d+) values", whole):
        return f"{found[1]}: expected {found[2]} value{'s' * (found[2] != '1')} after it {see}"
    if found := re.match(r"Unrecognized (?:or misplaced )?options: (.*?)(?: Perhaps you meant:? (--\S+).*)?$", whole):
        near = f"; did you mean {found[2]}?" if found[2] else ""
        return f"unknown option {found[1].replace(', ', ' ')}{near} {see}"
    if found := re.match(r"Error parsing (\S+): (.*?)(?: Argument helptext: (.*))?$", whole):
        given = re.search(r"invalid literal for int\(\) with base 10: (.*)$", found[2])
        if given:
            what = f"{given[1]} is not an int"
        elif given := re.match(r"could not convert string to float: (.*)$", found[2]):
            what = f"{given[1]} is not a number"
        elif "Exceeds the limit" in found[2]:
            what = "a number of so many digits is too long"
        elif given := re.search(r"(?:instantiated from|parse arguments) \[(.*?)\]", found[2]):
            kind = re.search(r"(?:[A-Z]{3,}|\{\S+)(?: [A-Z]{3,})*", found[3] or "")  # FLOAT FLOAT, {None}|INT
            what = f"{given[1]} is not {kind[0] if kind else 'possible'}"
        else:
            what = found[2]
        return f"{found[1]}: {what} {see}"
    if found := re.match(r"Missing from .*?: (.*)", whole):
        return f"missing {found[1].split(' (required)')[0]} {see}"
    return f"{whole} {see}"


def selectors(argv: list[str], names: Sequence[str]) -> tuple[dict[str, str], list[str]]:
    """Take the plain selectors out of ``argv``; what is left is for the chosen things' own fields."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    for name in names:
        parser.add_argument(name, dest=name)
    try:
        found, rest = parser.parse_known_args(argv)
    except argparse.ArgumentError as error:
        raise ValueError(f"{error.argument_name}: expected a value after it") from None
    return {name: value for name, value in vars(found).items() if value is not None}, rest
