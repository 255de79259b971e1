"""Figures of the code's structure: lines, files, options, words, imports, cycles, long functions, paths through the code.

    python -m benchmarks.house [ROOT] [--json FILE]

Nothing of the tree is imported or run, so any checkout can be measured.
"""

import argparse
import ast
import json
import re
from collections import Counter
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

Function = ast.FunctionDef | ast.AsyncFunctionDef
NAMED = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)
PATHS = {
    "pretrain": "mvitac.training.loop.train",
    "probe": "mvitac.evaluation.evaluate.probe_runs",
    "bench": "mvitac.bench.score.score_suite",
    "export": "mvitac.deploy.export.export",
}
"""Command -> the function that does its work."""


def modules(root: Path) -> dict[str, Path]:
    """Dotted name -> file of every module of the package."""
    files = sorted((root / "src").rglob("*.py"))
    return {".".join(f.relative_to(root / "src").with_suffix("").parts).removesuffix(".__init__"): f for f in files}


def statements(body: list[ast.stmt], inside: bool) -> Iterator[ast.stmt]:
    """Statements that run when a file is imported; with ``inside`` also those in functions and for types only."""
    for node in body:
        for_types = isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
        if not inside and (for_types or isinstance(node, Function)):
            continue
        yield node
        for part in ("body", "orelse", "finalbody"):
            yield from statements(getattr(node, part, []), inside)


def names(tree: ast.Module, known: dict[str, Path], inside: bool = False) -> dict[str, str]:
    """Name in a file -> dotted name of what it imports from the package: a module, or something in one."""
    found = {}
    for node in statements(tree.body, inside):
        if isinstance(node, ast.Import):
            found |= {alias.asname or alias.name: alias.name for alias in node.names if alias.name in known}
        elif isinstance(node, ast.ImportFrom) and node.module in known:
            found |= {alias.asname or alias.name: f"{node.module}.{alias.name}" for alias in node.names}
    return found


def module_of(name: str, known: dict[str, Path]) -> str:
    """The module that ``name`` is, or is in."""
    return name if name in known else name.rpartition(".")[0]


def room(name: str) -> str:
    """The package below mvitac that a module is in, or the module at the root itself."""
    return name.split(".")[1] if "." in name else name


def functions(tree: ast.Module) -> list[tuple[int, str]]:
    """Length in lines and name of every function."""
    nodes = (n for n in ast.walk(tree) if isinstance(n, Function))
    return [((n.end_lineno or n.lineno) - n.lineno + 1, n.name) for n in nodes]


def cycle(arrows: dict[str, set[str]]) -> list[str]:
    """One cycle of the graph, [] if there is none."""
    try:
        TopologicalSorter(arrows).prepare()
    except CycleError as error:
        return error.args[1]
    return []


def floors(rooms: dict[str, set[str]]) -> dict[str, int]:
    """How many packages lie below each, on its longest way down; {} if there is a cycle."""
    found: dict[str, int] = {}
    for name in TopologicalSorter(rooms).static_order() if not cycle(rooms) else ():
        found[name] = max((found[below] + 1 for below in rooms.get(name, ())), default=0)
    return found


def calls(start: str, trees: dict[str, ast.Module], known: dict[str, Path]) -> list[str]:
    """Functions and classes of the package that ``start`` calls by name, directly or not, each once, in reading order.

    A method is reached with its class: what an object is, its name does not tell.
    """
    things = ((f"{name}.{node.name}", node) for name in trees for node in trees[name].body if isinstance(node, NAMED))
    defined = dict(things)
    seen: list[str] = []

    def visit(name: str) -> None:
        if name in seen or name not in defined:
            return
        seen.append(name)
        home = module_of(name, known)
        imported = names(trees[home], known, inside=True)
        found = [n for n in ast.walk(defined[name]) if isinstance(n, ast.Call)]
        for node in sorted(found, key=lambda n: (n.lineno, n.col_offset)):
            parts = ast.unparse(node.func).split(".")
            target = imported.get(parts[0], f"{home}.{parts[0]}")
            visit(".".join([target, *parts[1:]]) if target in known else target)

    visit(start)
    return seen


def walk(start: str, trees: dict[str, ast.Module], known: dict[str, Path], floor: dict[str, int]) -> dict[str, int]:
    """Files entered by the calls of ``start``, stays in them, moves between packages, and climbs to a higher one."""
    files = [module_of(name, known) for name in calls(start, trees, known)]
    stays = [name for at, name in enumerate(files) if at == 0 or files[at - 1] != name]
    moves = [(a, b) for a, b in zip(map(room, stays), map(room, stays[1:]), strict=False) if a != b]
    climbs = sum(floor.get(b, 0) > floor.get(a, 0) for a, b in moves)
    return {"files": len(set(files)), "stays": len(stays), "moves": len(moves), "climbs": climbs}


def count(files: list[Path]) -> int:
    """Return the number of lines."""
    return sum(len(file.read_text().splitlines()) for file in files)


def options(root: Path) -> dict[str, set[str]]:
    """Command -> its options, as its stored help lists them."""
    helps = sorted((root / "src").rglob("cli/help/*.txt"))
    return {file.stem: set(re.findall(r"^ *(--[\w.-]*\w)", file.read_text(), re.MULTILINE)) for file in helps}


def measure(root: Path) -> dict[str, object]:
    """All figures of the checkout in ``root``."""
    known = modules(root)
    trees = {name: ast.parse(file.read_text()) for name, file in known.items()}

    def to(name: str, tree: ast.Module, inside: bool) -> set[str]:
        return {module_of(one, known) for one in names(tree, known, inside).values()} - {name}

    arrows, late = ({n: to(n, tree, inside) for n, tree in trees.items()} for inside in (False, True))
    pairs = Counter(
        (room(a), room(b)) for a in arrows for b in arrows[a] if room(a) != room(b) and "mvitac" not in (a, b)
    )
    rooms: dict[str, set[str]] = {}
    for a, b in pairs:
        rooms.setdefault(a, set()).add(b)
    lengths = [(*found, name) for name, tree in trees.items() for found in functions(tree)]
    pages = sorted([*root.glob("*.md"), *root.glob("docs/**/*.md")])
    lines = [line for file in pages for line in file.read_text().splitlines()]
    words = Counter[str]()
    for page in pages:
        words[str(page.parent.relative_to(root))] += len(page.read_text().split())
    given = options(root)
    folders = {name: [f for n, f in known.items() if room(n) == name and n != "mvitac"] for name in map(room, known)}
    return {
        "lines per package": {name: count(files) for name, files in folders.items() if files},
        "lines of src": count(list(known.values())),
        "lines of tests": count(sorted(root.glob("tests/**/*.py"))),
        "files of src": len(known),
        "files per package": {name: len(files) for name, files in folders.items() if files},
        "options by command": {command: len(found) for command, found in given.items()},
        "options": len(set[str]().union(*given.values())),
        "words by folder": dict(words),
        "words of docs": words.total(),
        "lines of prose over 120": sum(len(line) > 120 and not line.lstrip().startswith("|") for line in lines),
        "arrows between modules": sum(map(len, arrows.values())),
        "arrows between packages": len(pairs),
        "imports across packages": sum(pairs.values()),
        "floors": 1 + max(floors(rooms).values(), default=0),
        "cycle of packages": cycle(rooms),
        "cycle of modules": cycle({k: v for k, v in arrows.items() if k != "mvitac"}),
        "cycle of modules, late and types too": cycle({k: v for k, v in late.items() if k != "mvitac"}),
        "functions over 40 lines": sum(length > 40 for length, _, _ in lengths),
        "functions over 60 lines": sorted((f for f in lengths if f[0] > 60), reverse=True),
        **{f"path of {command}": walk(start, trees, known, floors(rooms)) for command, start in PATHS.items()},
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
