"""``mvitac data ...``: simulate, pack, look at what is in a pack."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mvitac.options import parse, selectors


def simulate(argv: list[str]) -> None:
    """mvitac data simulate materials|grasps --num ... --size ... --seed ... --out DIR"""
    from mvitac.datasets.simulated import SimulatedConfig
    from mvitac.registry import default, unknown

    names = sorted(cls.name for cls in SimulatedConfig.__subclasses__())
    if not argv or argv[0].startswith("-"):
        raise ValueError(f"say what to simulate: mvitac data simulate {'|'.join(names)} --out DIR")
    if argv[0] not in names:
        raise unknown("kind to simulate", argv[0], names)
    _build(default(SimulatedConfig, argv[0]), argv[1:], f"data simulate {argv[0]}")


def pack(argv: list[str]) -> None:
    """mvitac data pack --data NAME ... --out DIR"""
    from mvitac import datasets
    from mvitac.registry import default

    chosen, rest = selectors(argv, ("--data",))
    if "--data" not in chosen:
        raise ValueError(
            f"say which dataset: mvitac data pack --data {'|'.join(datasets.DatasetConfig.choices)} --out DIR"
        )
    # Spelt as in pretrain (--data.root) or short (--root).
    rest = [f"--{word.removeprefix('--data.')}" if word.startswith("--data.") else word for word in rest]
    _build(default(datasets.DatasetConfig, chosen["--data"]), rest, f"data pack --data {chosen['--data']}")


def _build(config: Any, argv: list[str], prog: str) -> None:
    from typing import Annotated

    import tyro
    from rich.console import Console

    from mvitac.pack import build
    from mvitac.record import check_place

    @dataclass(frozen=True, kw_only=True)
    class Options:
        out: Path
        """Folder of the new pack."""
        data: Annotated[type(config), tyro.conf.arg(name="")] = config  # type: ignore[valid-type]
        max_damaged: float = 0.0
        """Share of the items that may be unreadable before packing stops; they are listed in pack.json."""
        quiet: bool = False
        """No progress bar."""

    Options.__doc__ = type(config).__doc__
    options = parse(Options, argv, prog)
    check_place(options.out)
    source = options.data.source()
    pack = build(
        source,
        options.out,
        size=options.data.size,
        workers=options.data.workers,
        max_damaged=options.max_damaged,
        quiet=options.quiet,
    )
    console = Console()
    console.print(f"{pack.path}: {pack.num} samples at {pack.size} px", soft_wrap=True, highlight=False)
    if lost := pack.meta["damaged"]:
        text = f'{len(lost)} left out, listed under "damaged" in {pack.path / "pack.json"}; first {": ".join(lost[0])}'
        console.print(text, soft_wrap=True, highlight=False, markup=False)
    for note in pack.spec.notes:
        console.print(f"note: {note}", soft_wrap=True, highlight=False, markup=False)


def sheet(argv: list[str]) -> None:
    """mvitac data sheet materials|grasps [--out FILE.png]"""
    from typing import Literal

    import tyro
    from rich.console import Console

    @dataclass(frozen=True)
    class Options:
        """A picture of everything a simulator makes, for a person to judge."""

        kind: tyro.conf.Positional[Literal["materials", "grasps"]]
        """Which simulator."""
        out: Path | None = None
        """The picture (default: KIND.png here)."""
        seed: int = 0
        """World seed."""

    options = parse(Options, argv, "data sheet")
    from mvitac.record import write_atomic
    from mvitac.sim import grasps, sheet

    draw = {"materials": sheet.contact_sheet, "grasps": grasps.contact_sheet}[options.kind]
    out = options.out or Path(f"{options.kind}.png")
    if out.suffix.lower() != ".png":
        raise ValueError(f"--out {out}: the sheet is a PNG, give a name that ends in .png")
    if options.seed < 0:
        raise ValueError(f"--seed {options.seed}: give a number >= 0")
    write_atomic(out, lambda file: draw(file, seed=options.seed))
    Console().print(f"{out}", soft_wrap=True, highlight=False)


def info(argv: list[str]) -> None:
    """mvitac data info PACK"""
    import numpy as np
    from rich.console import Console
    from rich.table import Table
    from tyro.conf import Positional

    from mvitac.pack import SPLITS, Pack

    @dataclass(frozen=True)
    class Options:
        pack: Positional[Path]
        """Folder of the pack."""

    pack = Pack(parse(Options, argv, "data info").pack)
    table = Table(title=f"{pack.path}: {pack.spec.name}, {pack.num} samples at {pack.size} px", title_justify="left")
    for column in ("split", "rows", f"{pack.spec.group_by}s", *(f"{t.name}: majority" for t in pack.spec.tasks)):
        table.add_column(column)
    for split in SPLITS:
        rows = pack.rows(split)
        if not len(rows):
            continue
        cells = []
        for task in pack.spec.tasks:
            labels = pack.column(f"label_{task.name}")[pack.rows(split, only=task.only, by=task.split)]
            labels = labels[labels >= 0]
            common = np.bincount(labels).argmax() if len(labels) else None
            cells.append("" if common is None else f"{task.classes[common]} {100 * (labels == common).mean():.1f} %")
        table.add_row(split, str(len(rows)), str(len(set(pack.column("group")[rows]))), *cells)
    console = Console()
    console.print(table)
    console.print(f"source {pack.spec.source}; licence {pack.spec.licence}", soft_wrap=True, highlight=False)
    for note in pack.spec.notes:
        console.print(f"note: {note}", soft_wrap=True, highlight=False, markup=False)
