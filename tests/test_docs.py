"""The docs: what a page links to is there, and nothing stands twice."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = sorted(p.relative_to(ROOT).as_posix() for p in [*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")])


@pytest.mark.parametrize("name", PAGES)
def test_links_lead_somewhere(name: str) -> None:
    page = ROOT / name
    links = re.findall(r"\]\(([^)#\s]+)[^)]*\)", page.read_text())
    missing = [link for link in links if ":" not in link and not (page.parent / link).exists()]
    assert not missing


@pytest.mark.parametrize("name", PAGES)
def test_pages_that_are_named_exist(name: str) -> None:
    """In text and code too: ``docs/x.md`` is from the root."""
    named = set(re.findall(r"\bdocs/[\w/.-]+\.(?:md|png)\b", (ROOT / name).read_text()))
    assert not [path for path in sorted(named) if not (ROOT / path).exists()]


@pytest.mark.parametrize("name", PAGES)
def test_no_paragraph_stands_twice(name: str) -> None:
    """As after an edit by script that put a part of a page in twice."""
    long = [part for part in re.split(r"\n\s*\n", (ROOT / name).read_text()) if len(part) > 200]
    assert not [part[:80] for part, times in Counter(long).items() if times > 1]
