"""Atomic writes, reads with clear errors, digests of files."""

import contextlib
import errno
import hashlib
import json
import os
import re
import stat
import tempfile
import time
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO


def write_atomic(path: Path, write: Callable[[BinaryIO], object]) -> None:
    """Let ``write`` fill a temporary file next to ``path``, then rename it, so that no reader sees a partial file.

    Missing folders are created. After an error (full disk, Ctrl-C) ``path`` is unchanged. It is flushed to disk, against
    power loss. Temporary files that killed processes left are removed. A symbolic link stays one, and a device is refused.
    """
    check_ordinary(path)
    path = path.resolve() if path.is_symlink() else path
    path.parent.mkdir(parents=True, exist_ok=True)
    for name in os.listdir(path.parent):  # what killed processes left
        if name.endswith(".tmp") and (found := _TEMPORARY.fullmatch(name)) and found[1] == path.name:
            with contextlib.suppress(FileNotFoundError):
                if time.time() - path.with_name(name).stat().st_mtime > _STALE:
                    path.with_name(name).unlink()
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}.tmp")
    try:
        with naming(path), temporary.open("wb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException as error:
        with contextlib.suppress(OSError):
            temporary.unlink()
        if isinstance(error, OSError) and error.errno is None:  # numpy's "1000 requested and 0 written" on a full disk
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path)) from error
        raise


_TEMPORARY = re.compile(r"\.(.+)\.[0-9a-f]{32}\.tmp")
_STALE = 600  # seconds after which nobody is still writing a temporary file


def is_temporary(path: Path) -> bool:
    return _TEMPORARY.fullmatch(path.name) is not None


@contextlib.contextmanager
def naming(path: Path) -> Iterator[None]:
    """Name ``path`` in errors of writing it, because that of a full disk has no file name."""
    try:
        yield
    except OSError as error:
        error.filename = error.filename or str(path)
        raise


def check_ordinary(path: Path) -> None:
    """Raise ValueError if ``path`` is there and neither file nor folder: a rename would put a file in a device's place."""
    try:
        kind = stat.S_IFMT(path.stat().st_mode)  # OSError for a link to itself
    except FileNotFoundError:
        return
    if kind not in (stat.S_IFREG, stat.S_IFDIR):
        raise ValueError(f"{path} is neither a file nor a folder: choose another place")


def walk(folder: Path) -> Iterator[Path]:
    """Every path below ``folder``, hidden folders not entered; errors for one that is a link or cannot be read."""

    def stop(error: OSError) -> None:
        raise error

    for place, folders, files in os.walk(folder, onerror=stop):
        yield from (Path(place, name) for name in (*folders, *files))
        folders[:] = [name for name in folders if not name.startswith(".")]
        for link in (path for name in folders if (path := Path(place, name)).is_symlink()):
            raise ValueError(f"{link} is a link to a folder: put the folder in its place, or take it away")


def check_place(path: Path) -> None:
    """Raise ValueError if ``path`` cannot be written. Call it before the work whose result is written there."""
    parent = next((p for p in path.absolute().parents if os.path.lexists(p)), path)
    try:
        check_ordinary(path)  # raises OSError if the name is too long
        with tempfile.TemporaryFile(dir=parent):
            pass
    except OSError as error:
        raise ValueError(f"{path} cannot be written: {error.strerror} ({parent})") from None


def brief(error: BaseException) -> str:
    """Return the first line of a library's error, some 160 characters in whole words, to quote in an error message."""
    line = (str(error).strip().splitlines() or [type(error).__name__])[0]
    return line if len(line) <= 160 else f"{line[:156].rsplit(' ', 1)[0]} ..."


SEAL = "sha256"  # entry of a sealed JSON file: the ``digest`` of all others


def write_json(path: Path, value: Any, *, sealed: bool = False) -> None:
    """Write ``value`` as indented JSON, atomically. With ``sealed`` (objects only), ``read_json`` notices any change."""
    text = json.dumps(value, indent=1, allow_nan=False) + "\n"
    if sealed:
        value = json.loads(text)
        text = json.dumps({**value, SEAL: digest(value)}, indent=1) + "\n"
    write_atomic(path, lambda file: file.write(text.encode()))


def read_json(path: Path, what: str) -> Any:
    """Read a JSON file; ValueError says if it is missing, damaged, or changed since it was sealed. ``what`` describes it."""
    try:
        check_ordinary(path)  # a pipe never ends
        value = parse_json(path.read_text())
    except FileNotFoundError:
        raise ValueError(f"{path} does not exist: {what} is missing there") from None
    except (OSError, ValueError) as error:  # also: a folder, invalid UTF-8, numbers of 5000 digits
        why = f"{what} is damaged, or this is another file"
        raise ValueError(f"{path} is not valid JSON ({brief(error)}): {why}") from None
    if isinstance(value, dict) and SEAL in value and value.pop(SEAL) != digest(value):
        how = f"{what} was damaged or edited (or delete the entry {SEAL!r})"
        raise ValueError(f"{path} does not match its digest: {how}")
    return value


@contextlib.contextmanager
def fields_of(files: Path | str) -> Iterator[None]:
    """Raise ValueError if the code inside finds a field missing, or of another kind, in ``files``, perhaps a stranger's."""
    try:
        yield
    except (AttributeError, IndexError, KeyError, TypeError, AssertionError, ArithmeticError) as error:
        what = f"{type(error).__name__}: {brief(error)}"
        raise ValueError(f"{files} is damaged: a field is missing or of another kind ({what}): make it again") from None


CONTROL = re.compile(
    r"(?<!\\)(?:\\\\)*\\(?:[bf]|(?i:u00(?:0[0-8bcef]|1.|7f|[89].)|u20(?:2[a-e]|6[6-9])))"
    r"|[\x7f-\x9f\u202a-\u202e\u2066-\u2069\ud800-\udfff]"
)
"""What begins an escape sequence or turns text around, as itself or as JSON writes it: names may be a stranger's."""


def parse_json(text: str) -> Any:
    """Parse JSON; ValueError if it is invalid, nested more deeply than Python can read, or holds a control character."""
    if found := CONTROL.search(text):
        name = text[max(0, found.start() - 20) : found.end()]
        raise ValueError(f"control character in a name, {name!r}: rename it, a terminal would obey it")
    try:
        return json.loads(text, object_pairs_hook=_once)
    except RecursionError:
        raise ValueError("too many brackets inside each other") from None


def parse_toml(text: str) -> Any:
    """Parse TOML, as ``parse_json``."""
    import tomllib  # of Python 3.11: a robot may have 3.10, and needs no TOML

    try:
        return parse_json(json.dumps(tomllib.loads(text), default=str))
    except RecursionError:
        raise ValueError("too many brackets inside each other") from None


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    if len(found := dict(pairs)) < len(pairs):
        raise ValueError(f"two entries of one name: {', '.join(name for name, _ in pairs)}")
    return found


def digest(value: Any) -> str:
    """Return the sha256 (hex) of a JSON-ready value, independent of key order."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()


def digest_file(path: Path) -> str:
    found = hashlib.sha256()  # hashlib.file_digest needs Python 3.11; ROS 2 Humble has 3.10
    with path.open("rb") as file:
        while part := file.read(1 << 20):
            found.update(part)
    return found.hexdigest()


def cache_dir() -> Path:
    """Return the cache of packs and features: $MVITAC_CACHE, else $XDG_CACHE_HOME/mvitac, else ~/.cache/mvitac."""
    if "MVITAC_CACHE" in os.environ:
        return Path(os.environ["MVITAC_CACHE"]).expanduser()
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "mvitac"
