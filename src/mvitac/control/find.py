"""The closed-loop suites of this version."""

import tomllib
from pathlib import Path

from mvitac.control.insert import Insert
from mvitac.control.servo_rows import Servo
from mvitac.registry import from_json, unknown

SUITES = Path(__file__).parent / "suites"
Suite = Servo | Insert


def shipped() -> list[str]:
    """Names of the closed-loop suites of this version."""
    return sorted(path.stem for path in SUITES.glob("*.toml"))


def find_suite(name: str) -> Suite:
    """The suite ``name`` of this version."""
    if name not in shipped():
        raise unknown("suite", name, shipped())
    value = tomllib.loads((SUITES / f"{name}.toml").read_text())
    return from_json(Insert if value["kind"] == "insert" else Servo, value, "suite")
