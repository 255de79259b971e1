"""Files changed behind the library's back; of packs with digests that agree with the change."""

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from mvitac.bench.result import VOLATILE
from mvitac.system.files import digest, digest_file

Spoil = Callable[[Path], object]
Change = Callable[[Any], object]
"""Changes what was read from JSON, in place."""


def put(*keys: str | int, value: Any) -> Change:
    def change(inner: Any) -> None:
        for key in keys[:-1]:
            inner = inner[key]
        inner[keys[-1]] = value(inner[keys[-1]]) if callable(value) else value

    return change


def changed(file: Path, out: Path, change: Change, *, signed: bool = True) -> Path:
    """A copy of a result after ``change``; ``signed`` again, as someone would who wants to hide it."""
    value = json.loads(file.read_text())
    change(value)
    if signed:
        value["digest"] = digest({key: part for key, part in value.items() if key not in VOLATILE})
    out.write_text(json.dumps(value))
    return out


def edited(path: Path, keys: tuple[str, ...], value: Any) -> None:
    content = json.loads(path.read_text())
    content.pop("sha256", None)  # an edit that is meant
    put(*keys, value=value)(content)
    path.write_text(json.dumps(content))


def seal(path: Path) -> None:
    """Make pack.json promise what the files hold now, so that the checks behind the digests are reached."""
    meta = json.loads((path / "pack.json").read_text())
    meta["digests"] = {name: digest_file(path / name) for name in meta["digests"] if (path / name).exists()}
    meta.pop("digest", None)
    (path / "pack.json").write_text(json.dumps({**meta, "digest": digest(meta)}))


def described(*keys: str, value: Any) -> Spoil:
    def spoil(path: Path) -> None:
        edited(path / "pack.json", keys, value)
        seal(path)

    return spoil


def refuse_pipe(path: Path, read: Callable[[], object], says: str = "neither a file nor a folder") -> None:
    """Put a pipe in the place of ``path``: reading it would wait for ever."""
    path.unlink(missing_ok=True)
    os.mkfifo(path)
    with pytest.raises(ValueError, match=says):
        read()
