"""Checks of names: groups and classes that are probably one, typed in two ways."""

import re
import unicodedata
from collections import defaultdict
from collections.abc import Sequence

import numpy as np

from mvitac.data.checks.finding import Finding, judged
from mvitac.data.checks.table_checks import KEYS, sides_of
from mvitac.data.pack import Pack
from mvitac.data.spec import listed

MAX_SHOWN = 20


def similar_names(pack: Pack) -> Finding:
    """Find groups and classes whose names differ only in Unicode form, case, blanks or leading zeros."""
    notes: list[str] = []
    rows: list[int] = []
    sides = sides_of(pack.column("split").astype(str))
    for column in ("group", "touch_group", *KEYS):
        if column not in pack.table.column_names:
            continue
        values = pack.column(column).astype(str)
        alike = _alike(np.unique(values).tolist())
        on = [{side for name in names for side in sides[values == name].tolist()} for names in alike]
        apart = sum(len(found) > 1 for found in on)
        if alike:
            leak = f"; {apart} of these are in more than one split" if apart else ""
            notes.append(f"{column}: {_shown(alike)}{leak}")
            rows += [int(np.flatnonzero(values == name)[0]) for names in alike[:4] for name in names]
    for task in pack.spec.tasks:
        if alike := _alike(task.classes):
            notes.append(f"classes of {task.name}: {_shown(alike)}")
    evidence = "; ".join(dict.fromkeys(notes)) or "no two groups or classes differ only in case, blanks or zeros"
    advice = "if they mean the same, write them alike and pack again"
    return judged("names that differ in spelling only", evidence, advice, list(dict.fromkeys(rows)), look=bool(notes))


def _alike(names: Sequence[str]) -> list[list[str]]:
    """Return the sets of names with the same ``_key``."""
    found: dict[str, list[str]] = defaultdict(list)
    for name in names:
        found[_key(name)].append(name)
    return [several for several in found.values() if len(several) > 1]


def _key(name: str) -> str:
    """Return ``name`` without case, Unicode variants, invisible characters, leading zeros, and blanks next to letters."""
    text = unicodedata.normalize("NFKC", unicodedata.normalize("NFKC", name).casefold())
    text = "".join(c for c in text if unicodedata.category(c) != "Cf")
    text = re.sub(r"(?<!\d)[\s_]+|[\s_]+(?!\d)", "", text)
    return re.sub(r"(?<![\d.])0+(?=\d)", "", text)


def _shown(alike: list[list[str]]) -> str:
    # ascii() shows what looks the same on the screen: Unicode forms, non-breaking blanks.
    quoted = [" and ".join(repr(n) if n.isprintable() and n.isascii() else ascii(n) for n in names) for names in alike]
    return listed(quoted, MAX_SHOWN)
