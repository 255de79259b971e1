"""The tutorials run: every cell of every page, in order, in an empty folder.

So do the how-to pages docs/add_a_dataset.md, and docs/encoders.md and policies.md on the files that a tutorial leaves.
"""

import csv
import shlex
import sys
from pathlib import Path
from typing import Any

import jupytext
import numpy as np
import pytest
from PIL import Image

from mvitac.data.pack import Pack
from support.processes import begin, finish

pytestmark = pytest.mark.slow

DOCS = Path(__file__).parents[1] / "docs"
PAGES = sorted(p for p in (DOCS / "tutorials").glob("*.md") if p.name != "index.md")


def code_of(file: Path) -> list[str]:
    return [cell.source for cell in jupytext.read(file).cells if cell.cell_type == "code"]


def run(page: Path, folder: Path, names: dict[str, Any] | None = None) -> None:
    """Run the cells of ``page`` in ``folder`` and this process; their ``names`` are those of ``__main__`` by default."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        run_cells(page, vars(sys.modules["__main__"]) if names is None else names)


def run_cells(page: Path, names: dict[str, Any]) -> None:
    from mvitac.cli.main import main

    for source in code_of(page):
        if not source.startswith("%%bash\n"):
            exec(compile(source, page.name, "exec"), names)
            continue
        for command in source.replace("\\\n", " ").splitlines()[1:]:
            program, *arguments = shlex.split(command)
            assert program == "mvitac", f"{page.name} runs {program}, which this test cannot run"
            assert main(arguments) == 0, command


@pytest.mark.parametrize("page", [*PAGES, DOCS / "add_a_dataset.md"], ids=lambda p: p.stem)
def test_every_cell_runs(page: Path, tmp_path: Path) -> None:
    """Pages that register a method or a dataset, which the other tests must not see, in a process of their own."""
    (folder := tmp_path / "folder").mkdir()
    if "\nclass " in page.read_text():
        finish(begin(run, page, folder, output=tmp_path / "output"), tmp_path / "output")
    else:
        run(page, folder, {})


def test_later_pages_run(artifact: Path, pack: Pack, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("artifacts").mkdir()
    Path("artifacts/mine").symlink_to(artifact)
    Path("my_sensor").mkdir()
    with open("my_sensor/pairs.csv", "w", newline="") as file:
        table = csv.writer(file)
        table.writerow(["vision", "touch", "feel", "object"])
        for row in range(72):
            names = {m: f"{m}_{row:04}.png" for m in ("vision", "touch")}
            for modality, name in names.items():
                Image.fromarray(pack.images[modality][row]).save(f"my_sensor/{name}")
            table.writerow([*names.values(), pack.labels("bright")[row], pack.column("group")[row]])
    names: dict[str, Any] = {"__name__": "encoders"}
    code = code_of(DOCS / "encoders.md") + code_of(DOCS / "policies.md")
    assert len(code) == 5  # one of each section
    for source in code:
        exec(compile(source, "page", "exec"), names)
    assert names["features"]["touch"].shape == (72, 64) and names["scores"].mean() > 0.75  # chance is .5
    first = names["touches"][0]
    assert np.allclose(names["theirs"](Image.open(first)), names["prepare"](first), atol=1e-5)
