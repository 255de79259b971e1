"""The tutorials run: every cell of every page, in order, in an empty folder; their notebooks hold the same cells."""

from __future__ import annotations

import shlex
import subprocess
import sys
from pathlib import Path

import jupytext
import pytest

PAGES = sorted(p for p in (Path(__file__).parents[1] / "docs/tutorials").glob("*.md") if p.name != "index.md")


def cells(file: Path) -> list[tuple[str, str]]:
    """Kind and source of every cell of a page or notebook."""
    return [(cell.cell_type, cell.source) for cell in jupytext.read(file).cells]


def run(page: Path) -> None:
    """Run the code cells of ``page``. Its commands run in this process, which spares each the import of torch."""
    from mvitac.cli.main import main

    names = vars(sys.modules["__main__"])  # where a notebook's cells define their names, too
    for kind, source in cells(page):
        if kind != "code":
            continue
        if not source.startswith("%%bash\n"):
            exec(compile(source, page.name, "exec"), names)
            continue
        for command in source.splitlines()[1:]:
            program, *arguments = shlex.split(command)
            assert program == "mvitac", f"{page.name} runs {program}, which this test cannot run"
            assert main(arguments) == 0, command


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.stem)
def test_every_cell_runs(page: Path, tmp_path: Path) -> None:
    """In a process of its own: a tutorial may register a method that the other tests must not see."""
    ended = subprocess.run([sys.executable, __file__, page], cwd=tmp_path, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stdout + ended.stderr


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.stem)
def test_notebook_is_the_page(page: Path) -> None:
    notebook = page.with_suffix(".ipynb")
    assert cells(notebook) == cells(page), "write it anew: make notebooks"
    assert not any(cell.get("outputs") for cell in jupytext.read(notebook).cells)


if __name__ == "__main__":
    run(Path(sys.argv[1]))
