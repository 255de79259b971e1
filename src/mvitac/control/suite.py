"""Suites of closed-loop tasks (``suites/*.toml``): versioned definitions, with every criterion as data."""

import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from mvitac.registry import check_range, from_json, to_json, unknown
from mvitac.system.files import digest

SUITES = Path(__file__).parent / "suites"


@dataclass(frozen=True, kw_only=True)
class Condition:
    """What is different in some episodes of the same shapes."""

    name: str
    new_sensor: bool = False
    noise: float = 1.0  # multiplies the camera noise of the sensor
    latency_ms: int = 0


@dataclass(frozen=True, kw_only=True)
class LoopSuite:
    """What both kinds of suite have; their files say what each field means."""

    name: str
    title: str
    seed: int
    train_steps: int
    untrained: tuple[str, ...]
    imagenet: str
    pins: dict[str, str] = field(default_factory=dict)
    """Digests of what is learned from, where the suite was measured. Not in the digest of the definition."""

    def definition(self) -> dict[str, Any]:
        """The suite as JSON, without its pins."""
        return {name: value for name, value in to_json(self).items() if name != "pins"}

    def digest(self) -> str:
        return digest(self.definition())


@dataclass(frozen=True, kw_only=True)
class ServoSuite(LoopSuite):
    """Tasks of ``control.servo``, one controller, and what estimates its pose."""

    kind: Literal["servo"]
    shapes: int
    steps: int
    settle: int
    gain: float
    most: float
    fit_shapes: int
    fit_presses: int
    fit_val: int
    conditions: tuple[Condition, ...]

    def __post_init__(self) -> None:
        check_range(self, 2, 1000, "shapes")
        check_range(self, self.settle + 1, 10_000, "steps")


@dataclass(frozen=True, kw_only=True)
class InsertSuite(LoopSuite):
    """The task of ``control.insert``, and when it has succeeded."""

    kind: Literal["insert"]
    episodes: int
    demonstrations: tuple[int, ...]
    noise: float
    success_mm: float
    success_deg: float
    success_depth: float

    def __post_init__(self) -> None:
        check_range(self, 2, 10_000, "episodes")


def shipped() -> list[str]:
    """Names of the closed-loop suites of this version."""
    return sorted(path.stem for path in SUITES.glob("*.toml"))


def read_suite(value: dict[str, Any]) -> ServoSuite | InsertSuite:
    """The suite of a JSON object; ValueError if it is none."""
    return from_json(InsertSuite if value.get("kind") == "insert" else ServoSuite, value, "suite")


def find_suite(name: str) -> ServoSuite | InsertSuite:
    """The suite ``name`` of this version."""
    if name not in shipped():
        raise unknown("suite", name, shipped())
    return read_suite(tomllib.loads((SUITES / f"{name}.toml").read_text()))
