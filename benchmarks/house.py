"""Figures of the code's structure: modules, imports, cycles, long functions, words of documentation.

    python -m benchmarks.house [ROOT] [--json FILE]

Nothing of the tree is imported or run, so any checkout can be measured.
"""

import argparse
import ast
import json
import re
from collections import Counter
from graphlib import CycleError, TopologicalSorter
from pathlib import Path


def modules(root: Path) -> dict[str, Path]:
    """Dotted name -> file of every module of the package."""
    files = sorted((root / "src").rglob("*.py"))
    return {".".join(f.relative_to(root / "src").with_suffix("").parts).removesuffix(".__init__"): f for f in files}


def imports(name: str, file: Path, known: dict[str, Path]) -> set[str]:
    """Modules of the package that ``file`` imports when it is imported itself: not in functions, not for types only."""

    def statements(body: list[ast.stmt]) -> list[ast.stmt]:
        found = []
        for node in body:
            if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
                continue
            if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
                continue
            found.append(node)
            for part in ("body", "orelse", "finalbody"):
                found += statements(getattr(node, part, []))
        return found

    asked = set()
    for node in statements(ast.parse(file.read_text()).body):
        if isinstance(node, ast.Import):
            asked |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            inside = {f"{node.module}.{alias.name}" for alias in node.names}
            asked |= {one if one in known else node.module for one in inside}
    return {one for one in asked if one in known} - {name}


def room(name: str) -> str:
    """The package below mvitac that a module is in, or the module at the root itself."""
    return name.split(".")[1] if "." in name else name


def reached(start: str, arrows: dict[str, set[str]]) -> set[str]:
    """Modules imported by ``start``, directly or not, itself included; packages above them are imported, too."""
    seen: set[str] = set()
    waiting = {start}
    while waiting:
        name = waiting.pop()
        seen.add(name)
        above = {name.rpartition(".")[0]} & arrows.keys()
        waiting |= (arrows[name] | above) - seen
    return seen


def one_choice(arrows: dict[str, set[str]]) -> dict[str, set[str]]:
    """The graph where methods and datasets do not import every file of their folder to register it."""
    return {name: set() if name in ("mvitac.methods", "mvitac.datasets") else to for name, to in arrows.items()}


def functions(file: Path) -> list[tuple[int, str]]:
    """Length in lines and name of every function."""
    nodes = (n for n in ast.walk(ast.parse(file.read_text())) if isinstance(n, (ast.FunctionDef, ast.AsyncFunctionDef)))
    return [((n.end_lineno or n.lineno) - n.lineno + 1, n.name) for n in nodes]


def cycle(arrows: dict[str, set[str]]) -> list[str]:
    """One cycle of the graph, [] if there is none."""
    try:
        TopologicalSorter(arrows).prepare()
    except CycleError as error:
        return error.args[1]
    return []


def measure(root: Path) -> dict[str, object]:
    """All figures of the checkout in ``root``."""
    known = modules(root)
    arrows = {name: imports(name, file, known) for name, file in known.items()}
    pairs = Counter(
        (room(a), room(b)) for a in arrows for b in arrows[a] if room(a) != room(b) and "mvitac" not in (a, b)
    )
    rooms: dict[str, set[str]] = {}
    for a, b in pairs:
        rooms.setdefault(a, set()).add(b)
    loop = "mvitac.training.loop" if "mvitac.training.loop" in known else "mvitac.train"
    needed = reached(loop, one_choice(arrows))
    lengths = [(*found, name) for name, file in known.items() for found in functions(file)]
    docs = sorted([*root.glob("*.md"), *root.glob("docs/**/*.md")])
    lines = [line for file in docs for line in file.read_text().splitlines()]
    return {
        "modules per folder": dict(Counter(str(f.parent.relative_to(root / "src")) for f in known.values())),
        "arrows between modules": sum(map(len, arrows.values())),
        "arrows between packages": len(pairs),
        "imports across packages": sum(pairs.values()),
        "cycle of packages": cycle(rooms),
        "cycle of modules": cycle({k: v for k, v in arrows.items() if k != "mvitac"}),
        f"files reached from {loop}": len(needed),
        f"lines reached from {loop}": sum(len(known[name].read_text().splitlines()) for name in needed),
        "lines of src": sum(len(f.read_text().splitlines()) for f in known.values()),
        "functions over 40 lines": sum(length > 40 for length, _, _ in lengths),
        "functions over 60 lines": sorted((f for f in lengths if f[0] > 60), reverse=True),
        "words of docs": sum(len(re.findall(r"\S+", line)) for line in lines),
        "lines of docs over 120": sum(len(line) > 120 for line in lines),
        "lines of prose over 120": sum(len(line) > 120 and not line.lstrip().startswith("|") for line in lines),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("root", type=Path, nargs="?", default=Path("."), help="a checkout (default: this one)")
    parser.add_argument("--json", type=Path, help="also write the figures to this file")
    options = parser.parse_args()
    found = measure(options.root)
    for name, value in found.items():
        print(f"{name:45} {value}")
    if options.json:
        options.json.write_text(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
