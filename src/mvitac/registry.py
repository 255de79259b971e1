"""Kinds of things (methods, datasets) that register by being defined, and their configs as plain JSON.

A *kind* is a direct subclass of ``Registered``; every later subclass with a ``name`` is one choice of that kind:

    class MethodConfig(Registered): ...
    class MViTacConfig(MethodConfig): name = "mvitac"
    find(MethodConfig, "mvitac") is MViTacConfig
"""

from __future__ import annotations

import dataclasses
import difflib
import importlib
import pkgutil
import types
import typing
from pathlib import Path
from typing import Any, ClassVar, TypeVar

T = TypeVar("T")


class Registered:
    """Base of every kind; ``choices`` maps the names defined so far to their classes, one dict per kind."""

    name: ClassVar[str]
    choices: ClassVar[dict[str, type]]

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if Registered in cls.__bases__:
            cls.choices = {}
        elif "name" in cls.__dict__:
            known = cls.choices.get(cls.name)
            # A dataclass with slots is defined twice under one qualified name; anything else is a clash.
            assert known is None or known.__qualname__ == cls.__qualname__, f"two classes are named {cls.name!r}"
            cls.choices[cls.name] = cls


def unknown(what: str, given: str, allowed: typing.Iterable[str]) -> ValueError:
    """A ValueError that says what was given, what is allowed, and the likeliest intention."""
    allowed = list(allowed)
    near = difflib.get_close_matches(given, allowed, n=1)
    hint = f"; did you mean {near[0]!r}?" if near else ""
    return ValueError(f"unknown {what} {given!r}: choose from {', '.join(allowed)}{hint}")


def find(kind: type[T], name: str) -> type[T]:
    """The class registered under ``name``; ValueError names the choices."""
    choices = kind.choices  # type: ignore[attr-defined]
    if name not in choices:
        raise unknown(kind.__name__.removesuffix("Config").lower(), name, choices)
    return choices[name]


def default(kind: type[T], name: str) -> T:
    """The class registered under ``name`` with all its defaults."""
    return find(kind, name)()


def import_all(package: str, path: typing.Iterable[str]) -> None:
    """Import every module of ``package``, so that what they define is registered: a new choice is one new file."""
    for module in pkgutil.iter_modules(path):
        importlib.import_module(f"{package}.{module.name}")


LATER = {"later": True}
"""Metadata of a field that joined a format later: it is written only where it is not at its default, so that whatever does
without it keeps its bytes and digests."""


LATER_IN_DIGEST = {"later in digest": True}
"""The same for a field that is always written, but is left out of digests at its default."""


def to_json(config: Any, *, for_digest: bool = False) -> Any:
    """A (nested) config dataclass as JSON-ready values; a registered one carries its ``name``.

    With ``for_digest``, without the fields of ``LATER_IN_DIGEST`` that are at their default.
    """
    if dataclasses.is_dataclass(config) and not isinstance(config, type):
        left_out = (LATER, LATER_IN_DIGEST) if for_digest else (LATER,)
        said = [
            f for f in dataclasses.fields(config) if f.metadata not in left_out or getattr(config, f.name) != f.default
        ]
        fields = {f.name: to_json(getattr(config, f.name), for_digest=for_digest) for f in said}
        return {"name": config.name, **fields} if isinstance(config, Registered) else fields
    if isinstance(config, dict):
        return {str(key): to_json(value, for_digest=for_digest) for key, value in config.items()}
    if isinstance(config, (list, tuple)):
        return [to_json(value, for_digest=for_digest) for value in config]
    return str(config) if isinstance(config, Path) else config


def from_json(annotation: Any, value: Any, where: str = "run") -> Any:
    """Rebuild what ``to_json`` wrote, by the field annotations; ValueError names the field that does not fit."""
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if origin in (types.UnionType, typing.Union):
        if value is None and type(None) in arguments:
            return None
        inner = [a for a in arguments if a is not type(None)]
        return from_json(inner[0], value, where) if len(inner) == 1 else value
    if origin is typing.Literal:
        if not any(value == a and type(value) is type(a) for a in arguments):
            raise unknown(f"value of {where}", str(value), [str(a) for a in arguments])
        return value
    if origin is tuple:
        if not isinstance(value, list):
            raise ValueError(f"{where}: expected a list, got {value!r}")
        each = [arguments[0]] * len(value) if len(arguments) == 2 and arguments[1] is Ellipsis else arguments
        if len(each) != len(value):
            raise ValueError(f"{where}: expected {len(each)} values, got {value!r}")
        return tuple(from_json(a, v, where) for a, v in zip(each, value, strict=True))
    if origin is dict:
        if not isinstance(value, dict):
            raise ValueError(f"{where}: expected an object, got {value!r}")
        return {key: from_json(arguments[1], v, f"{where}.{key}") for key, v in value.items()}
    if isinstance(annotation, type) and dataclasses.is_dataclass(annotation):
        if not isinstance(value, dict):
            raise ValueError(f"{where}: expected an object, got {value!r}")
        given, cls = dict(value), annotation
        if issubclass(annotation, Registered):
            name = given.pop("name", "")
            if not isinstance(name, str):
                raise ValueError(f"{where}.name: expected one of {', '.join(annotation.choices)}, got {name!r}")
            cls = find(annotation, name)
        hints = typing.get_type_hints(cls)
        known = {f.name for f in dataclasses.fields(cls)}
        for key in given:
            if key not in known:
                raise unknown(f"field in {where}", key, sorted(known))
        for field in dataclasses.fields(cls):
            required = field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
            if required and field.name not in given:
                raise ValueError(f"{where}: field {field.name!r} is missing")
        return cls(**{key: from_json(hints[key], v, f"{where}.{key}") for key, v in given.items()})
    if annotation is Path:
        if not isinstance(value, str) or "\0" in value:
            raise ValueError(f"{where}: expected a path (text without NUL characters), got {value!r}")
        return Path(value)
    if annotation is float and isinstance(value, int) and not isinstance(value, bool):
        if abs(value) > 1 << 1000:
            raise ValueError(f"{where}: {str(value)[:20]}... is too large for a number")
        return float(value)
    wrong = isinstance(annotation, type) and annotation is not Any and not isinstance(value, annotation)
    if wrong or (isinstance(value, bool) and annotation in (int, float)):  # a bool is an int to Python only
        raise ValueError(f"{where}: expected {annotation.__name__}, got {value!r}")
    return value
