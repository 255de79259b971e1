"""The result of one check."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

Verdict = Literal["ok", "look", "broken", "not checkable"]
MAX_ROWS = 64


@dataclass(frozen=True)
class Finding:
    item: str
    verdict: Verdict
    evidence: str  # what was measured, in one line
    advice: str = ""  # what to do; "" if nothing is wrong
    rows: Sequence[int] = ()  # suspicious rows for the contact sheet, of which ``MAX_ROWS`` are kept


def judged(
    item: str, evidence: str, advice: str, rows: Sequence[int] = (), *, look: bool = True, broken: bool = False
) -> Finding:
    """A finding that is broken, worth a ``look``, or ok, and then without ``advice``."""
    wrong = look or broken
    verdict = "broken" if broken else "look" if look else "ok"
    return Finding(item, verdict, evidence, advice * wrong, tuple(map(int, rows[:MAX_ROWS])) if wrong else ())


def exit_code(findings: Iterable[Finding]) -> int:
    """Return 0 if all is well, 1 if someone should look, 2 if something is broken."""
    return max(({"broken": 2, "look": 1}.get(finding.verdict, 0) for finding in findings), default=0)


def share(part: int, whole: int) -> str:
    """Return a text such as '12 of 340 (3.5 %)'."""
    return f"{part} of {whole} ({100 * part / max(1, whole):.1f} %)"
