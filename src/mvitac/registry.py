"""Registry of methods and datasets, and conversion of their configs to and from JSON.

A *kind* is a direct subclass of ``Registered``. Each further subclass that has a ``name`` is one choice of that kind:

    class MethodConfig(Registered): ...
    class MViTacConfig(MethodConfig): name = "mvitac"
    find(MethodConfig, "mvitac") is MViTacConfig
"""

import dataclasses
import difflib
import importlib
import math
import pkgutil
import types
import typing
from pathlib import Path
from typing import Any, ClassVar, TypeVar

T = TypeVar("T")

PLACES = ("dataset", "plan", "suite")  # what may be named by a path, too


class Registered:
    """Base class of every kind. ``choices`` maps each registered name of the kind to its class."""

    name: ClassVar[str]
    choices: ClassVar[dict[str, type]]

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if Registered in cls.__bases__:
            cls.choices = {}
        elif "name" in cls.__dict__:
            known = cls.choices.get(cls.name)
            # dataclass(slots=True) defines the class twice under one qualified name; any other duplicate is an error.
            assert known is None or known.__qualname__ == cls.__qualname__, f"two classes are named {cls.name!r}"
            cls.choices[cls.name] = cls


def unknown(what: str, given: str, allowed: typing.Iterable[str]) -> ValueError:
    """Return a ValueError that names the given value, the allowed ones and the closest match."""
    if what in PLACES and not Path(given).exists() and ("/" in given or Path(given).suffix):
        return ValueError(f"{given} does not exist: give a file that does, or the name of a {what}")
    allowed = list(allowed)
    near = difflib.get_close_matches(given, allowed, n=1)
    hint = f"; did you mean {near[0]!r}?" if near else ""
    return ValueError(f"unknown {what} {given!r}: choose from {', '.join(allowed)}{hint}")


def check_known(what: str, given: typing.Iterable[str], allowed: typing.Collection[str]) -> None:
    """Raise ``unknown`` for the first of ``given`` that is not among ``allowed``."""
    for name in given:
        if name not in allowed:
            raise unknown(what, name, allowed)


def check_range(config: object, low: float, high: float, *names: str) -> None:
    """ValueError unless the numbers ``names`` of ``config`` are finite and from ``low`` to ``high``."""
    for name in names:
        if not (low <= (value := getattr(config, name)) <= high and math.isfinite(value)):
            most = f"to {high}" if high < math.inf else "or more, a finite number" if value == high else "or more"
            raise ValueError(f"{name} {value}: give {low} {most}")


def find(kind: type[T], name: str) -> type[T]:
    """Return the class registered under ``name``; the ValueError for an unknown name lists the choices."""
    choices = kind.choices  # type: ignore[attr-defined]
    check_known(kind.__name__.removesuffix("Config").lower(), [name], choices)
    return choices[name]


def default(kind: type[T], name: str) -> T:
    return find(kind, name)()


def import_all(package: str, path: typing.Iterable[str]) -> None:
    """Import every module of ``package`` to register its classes, so that adding a choice needs one new file only."""
    for module in pkgutil.iter_modules(path):
        importlib.import_module(f"{package}.{module.name}")


def to_json(config: Any) -> Any:
    """Convert a (nested) config dataclass to JSON-ready values; a registered class is stored with its ``name``."""
    if dataclasses.is_dataclass(config) and not isinstance(config, type):
        fields = {field.name: to_json(getattr(config, field.name)) for field in dataclasses.fields(config)}
        return {"name": config.name, **fields} if isinstance(config, Registered) else fields
    if isinstance(config, dict):
        return {str(key): to_json(value) for key, value in config.items()}
    if isinstance(config, (list, tuple)):
        return [to_json(value) for value in config]
    return str(config) if isinstance(config, Path) else config


def from_json(annotation: Any, value: Any, where: str = "run") -> Any:
    """Rebuild a value of type ``annotation`` (a dataclass, container or plain type) that was written by ``to_json``.

    ValueError if a value does not have the annotated type; the message names the field, which begins with ``where``.
    """
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
    nested = isinstance(annotation, type) and dataclasses.is_dataclass(annotation)
    if (origin is dict or nested) and not isinstance(value, dict):
        raise ValueError(f"{where}: expected an object, got {value!r}")
    if origin is dict:
        return {key: from_json(arguments[1], v, f"{where}.{key}") for key, v in value.items()}
    if nested:
        return _dataclass_from_json(annotation, dict(value), where)
    return _scalar_from_json(annotation, value, where)


def _dataclass_from_json(cls: type, given: dict[str, Any], where: str) -> Any:
    if issubclass(cls, Registered):
        if not isinstance(name := given.pop("name", ""), str):
            raise ValueError(f"{where}.name: expected one of {', '.join(cls.choices)}, got {name!r}")
        cls = find(cls, name)
    names, hints = sorted(field.name for field in dataclasses.fields(cls)), typing.get_type_hints(cls)  # type: ignore[arg-type]
    check_known(f"field in {where}", given, names)
    none, required = dataclasses.MISSING, [f for f in dataclasses.fields(cls) if f.name not in given]  # type: ignore[arg-type]
    if missing := [f.name for f in required if f.default is none and f.default_factory is none]:
        raise ValueError(f"{where}: give {', '.join(missing)}, too")
    return cls(**{key: from_json(hints[key], v, f"{where}.{key}") for key, v in given.items()})


def _scalar_from_json(annotation: Any, value: Any, where: str) -> Any:
    if annotation is Path:
        if not isinstance(value, str):
            raise ValueError(f"{where}: expected a path, got {value!r}")
        return Path(value)
    if annotation is float and isinstance(value, int) and not isinstance(value, bool):
        if abs(value) > 1 << 1000:
            raise ValueError(f"{where}: {str(value)[:20]}... is too large for a number")
        return float(value)
    wrong = isinstance(annotation, type) and annotation is not Any and not isinstance(value, annotation)
    if wrong or (isinstance(value, bool) and annotation in (int, float)):  # in Python, bool is a subclass of int
        raise ValueError(f"{where}: expected {annotation.__name__}, got {value!r}")
    return value
