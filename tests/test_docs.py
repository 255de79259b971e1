"""The docs: what a page names is there, its commands have these options, and nothing stands twice."""

import re
from collections import Counter
from dataclasses import fields
from pathlib import Path

import pytest

from mvitac.datasets import DatasetConfig
from mvitac.methods import MethodConfig

ROOT = Path(__file__).parents[1]
PAGES = sorted(p.relative_to(ROOT).as_posix() for p in [*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")])


@pytest.mark.parametrize("name", PAGES)
def test_a_page_names_what_is_there_and_nothing_twice(name: str) -> None:
    page, text = ROOT / name, (ROOT / name).read_text()
    links = re.findall(r"\]\(([^)#\s]+)[^)]*\)", text)
    assert not [link for link in links if ":" not in link and not (page.parent / link).exists()]
    named = set(re.findall(r"\bdocs/[\w/.-]+\.(?:md|png)\b", text))  # in text and code too, from the root
    assert not [path for path in sorted(named) if not (ROOT / path).exists()]
    long = [part for part in re.split(r"\n\s*\n", text) if len(part) > 200]
    assert not [part[:80] for part, times in Counter(long).items() if times > 1]
    assert not [line for line in text.splitlines() if len(line) > 120 and not line.lstrip().startswith("|")]


def test_every_picture_is_on_a_page() -> None:
    text = "".join((ROOT / name).read_text() for name in PAGES)
    assert not [p.name for p in (ROOT / "docs").rglob("*.png") if p.name not in text]


def known_options() -> set[str]:
    """Options in the stored helps, and those of every dataset and method, which stand there for the default only."""
    helps = (ROOT / "src/mvitac/cli/help").glob("*.txt")
    options = {option for file in helps for option in re.findall(r"--[a-z][a-z0-9.-]*[a-z0-9]", file.read_text())}
    options |= {option.replace("--data.", "--") for option in options}  # as `mvitac data ...` spells them
    options |= {option.replace("--encoder.vision.", "--encoder.") for option in options}  # short for both modalities
    options |= {"--max-damaged"}  # of `data pack`, shown when a dataset is named
    options |= {"--tyro-print-completion"}
    for base, prefixes in ((DatasetConfig, ("--data.", "--")), (MethodConfig, ("--method.", "--method.no-"))):
        for config in base.choices.values():
            options |= {p + field.name.replace("_", "-") for field in fields(config) for p in prefixes}
    return options


@pytest.mark.parametrize("name", PAGES)
def test_options_of_commands_exist(name: str) -> None:
    """In lines of code that run ``mvitac``, and in words of code that begin with ``--``."""
    text = (ROOT / name).read_text().replace("\\\n", " ")
    commands = re.findall(r"^(?:    |)mvitac .*$|`(?:mvitac [^`]*|--[^`]*)`", text, flags=re.MULTILINE)
    options = {o for command in commands for o in re.findall(r"(?<![\w-])--[a-z][a-z0-9.-]*[a-z0-9]", command)}
    assert not sorted(options - known_options())
