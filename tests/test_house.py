"""benchmarks/house.py counts what it says, on a tree small enough to count by hand."""

from __future__ import annotations

from pathlib import Path

from benchmarks.house import measure


def test_figures_of_a_small_tree(tmp_path: Path) -> None:
    files = {
        "src/mvitac/__init__.py": "",
        "src/mvitac/training/__init__.py": "",
        "src/mvitac/training/loop.py": "from mvitac.nn import loss\nfrom mvitac.run import Run\n"
        "def train():\n    loss.late(1)\n    end()\ndef end(): ...\n",
        "src/mvitac/cli/help/pretrain.txt": "  --out PATH   as --no-word says\n  --steps INT  how many\n",
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
    assert found["files per package"] == {"training": 2, "nn": 2, "run": 1, "unused": 1}
    assert found["arrows between packages"] == 3  # training -> nn, training -> run, unused -> run
    assert (
        found["cycle of packages"] == found["cycle of modules"] == []
    )  # imports in functions and for types do not count
    assert found["functions over 40 lines"] == 1 and found["functions over 60 lines"] == []
    assert (found["words of docs"], found["lines of prose over 120"]) == (6, 1)
    assert (found["options"], found["options by command"]) == (2, {"pretrain": 2})
    # train calls loss.late in nn, below, then its own second function: two moves, one of them a climb
    assert found["path of pretrain"] == {"files": 2, "stays": 3, "moves": 2, "climbs": 1}

    (tmp_path / "src/mvitac/run.py").write_text("import mvitac.training.loop\n")
    assert set(measure(tmp_path)["cycle of packages"]) == {"training", "run"}  # type: ignore[call-overload]
