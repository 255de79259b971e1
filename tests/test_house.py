"""benchmarks/house.py counts what it says, on a tree small enough to count by hand."""

from __future__ import annotations

from pathlib import Path

from benchmarks.house import measure


def test_figures_of_a_small_tree(tmp_path: Path) -> None:
    files = {
        "src/mvitac/__init__.py": "",
        "src/mvitac/training/__init__.py": "",
        "src/mvitac/training/loop.py": "from mvitac.nn import loss\nfrom mvitac.run import Run\n",
        "src/mvitac/nn/__init__.py": "",
        "src/mvitac/nn/loss.py": "def late():\n    import mvitac.training.loop\n" + "    pass\n" * 40,
        "src/mvitac/run.py": "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from mvitac.nn import loss\n",
        "src/mvitac/unused.py": "import mvitac.run\n",
        "docs/page.md": f"two words\n{'x' * 121}\n| {'x' * 121} |\n",
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    found = measure(tmp_path)
    assert found["modules per folder"] == {"mvitac": 3, "mvitac/nn": 2, "mvitac/training": 2}
    assert found["arrows between packages"] == 3  # training -> nn, training -> run, unused -> run
    assert (
        found["cycle of packages"] == found["cycle of modules"] == []
    )  # imports in functions and for types do not count
    assert found["files reached from mvitac.training.loop"] == 6  # all but unused.py
    assert found["functions over 40 lines"] == 1 and found["functions over 60 lines"] == []
    assert (found["words of docs"], found["lines of docs over 120"], found["lines of prose over 120"]) == (6, 2, 1)

    (tmp_path / "src/mvitac/run.py").write_text("import mvitac.training.loop\n")
    assert set(measure(tmp_path)["cycle of packages"]) == {"training", "run"}  # type: ignore[call-overload]
