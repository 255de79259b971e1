"""``mvitac data ...``: simulate, pack, look at what is in a pack."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mvitac.cli.options import parse, selectors, short


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
    _build(default(datasets.DatasetConfig, chosen["--data"]), short(rest), f"data pack --data {chosen['--data']}")


def _build(config: Any, argv: list[str], prog: str) -> None:
    from typing import Annotated

    import tyro
    from rich.console import Console

    from mvitac.data.build import build
    from mvitac.system.files import check_place

    @dataclass(frozen=True, kw_only=True)
    class Options:
        out: Path
        """Folder of the new pack."""
        data: Annotated[type(config), tyro.conf.arg(name="", help=config.__doc__)] = config  # type: ignore[valid-type]
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
        store=options.data.store,
        quality=options.data.quality,
        max_damaged=options.max_damaged,
        quiet=options.quiet,
    )
    console = Console(markup=False)
    console.print(f"{pack.path}: {pack.num} samples at {pack.size} px", soft_wrap=True, highlight=False)
    if lost := pack.meta["damaged"]:
        text = f'{len(lost)} left out, listed under "damaged" in {pack.path / "pack.json"}; first {": ".join(lost[0])}'
        console.print(text, soft_wrap=True, highlight=False)
    for note in pack.spec.notes:
        console.print(f"note: {note}", soft_wrap=True, highlight=False)


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
    from mvitac.sim import contact_sheet, grasps
    from mvitac.system.files import write_atomic

    draw = {"materials": contact_sheet.contact_sheet, "grasps": grasps.contact_sheet}[options.kind]
    out = options.out or Path(f"{options.kind}.png")
    if out.suffix.lower() != ".png":
        raise ValueError(f"--out {out}: the sheet is a PNG, give a name that ends in .png")
    if options.seed < 0:
        raise ValueError(f"--seed {options.seed}: give a number >= 0")
    write_atomic(out, lambda file: draw(file, seed=options.seed))
    Console(markup=False).print(f"{out}", soft_wrap=True, highlight=False)


def shard(argv: list[str]) -> None:
    """mvitac data shard PACK URL [--shard-mb 64]"""
    from rich.console import Console
    from tyro.conf import Positional

    @dataclass(frozen=True)
    class Options:
        """A pack in shards, for data larger than a machine's memory or disk: shards are read whole and in sequence.

        mvitac data shard PACK s3://bucket/path

        mvitac pretrain --data stream --data.url s3://bucket/path --data.cache /scratch/cache --data.cache-gb 50 ...

        Rows of one touch stay together, touches come in random order. What was interrupted is written again.
        """

        pack: Positional[Path]
        """Folder of the pack."""
        url: Positional[str]
        """Where the shards go: a folder, file:///..., s3://bucket/path (needs mvitac[s3]), or whatever fsspec
        opens."""
        shard_mb: float = 64
        """Megabytes of images per shard at most, camera and touch together."""
        seed: int = 0
        """Another number is another order of the touches."""
        quiet: bool = False
        """No progress bar."""

    options = parse(Options, argv, "data shard")
    from mvitac.data.pack import Pack
    from mvitac.data.sharding import write_shards

    pack = Pack(options.pack)
    num = write_shards(pack, options.url, shard_mb=options.shard_mb, seed=options.seed, quiet=options.quiet)
    Console(markup=False).print(f"{options.url}: {pack.num} samples in {num} shards", soft_wrap=True, highlight=False)


def info(argv: list[str]) -> None:
    """mvitac data info PACK"""
    import numpy as np
    from rich.console import Console
    from rich.table import Table
    from tyro.conf import Positional

    from mvitac.data.pack import SPLITS, Pack

    @dataclass(frozen=True)
    class Options:
        pack: Positional[Path]
        """Folder of the pack."""

    pack = Pack(parse(Options, argv, "data info").pack)
    stored = "" if pack.store == "raw" else f", JPEG of quality {pack.meta['quality']}"
    title = f"{pack.path}: {pack.spec.name}, {pack.num} samples at {pack.size} px{stored}"
    table = Table(title=title, title_justify="left")
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
    console = Console(markup=False)
    console.print(table)
    if len(gaps := [m for m in pack.spec.modalities if not pack.has(m).all()]):
        whole = int(np.logical_and.reduce([pack.has(m) for m in pack.spec.modalities]).sum())
        lacking = ", ".join(f"{int((~pack.has(m)).sum())} rows without {m}" for m in gaps)
        console.print(f"{lacking}; {whole} whole pairs", soft_wrap=True, highlight=False)
    console.print(f"source {pack.spec.source}; licence {pack.spec.licence}", soft_wrap=True, highlight=False)
    for note in pack.spec.notes:
        console.print(f"note: {note}", soft_wrap=True, highlight=False)


def show(argv: list[str]) -> None:
    """mvitac data show PACK [--by TASK|COLUMN] [--out FILE.png|FILE.html]"""
    from rich.console import Console
    from tyro.conf import Positional

    @dataclass(frozen=True)
    class Options:
        """A few pairs of every class or object, for a person to judge."""

        pack: Positional[Path]
        """Folder of the pack."""
        by: str = ""
        """Task or table column, one strip per value; default: the first task, else the group."""
        split: str = ""
        """Show rows of train, val, test or unlabelled only."""
        num: int = 6
        """Pairs per strip, of different groups where there are so many."""
        limit: int = 40
        """Strips at most."""
        side: int = 96
        """Height of a picture in pixels."""
        seed: int = 0
        """Another number is another draw."""
        out: Path | None = None
        """A .png or an .html; default: <pack's name>.png here."""

    options = parse(Options, argv, "data show")
    out = options.out or Path(f"{options.pack.resolve().name}.png")
    if out.suffix.lower() not in (".png", ".html"):
        raise ValueError(f"--out {out}: give a name that ends in .png or .html")
    if not 16 <= options.side <= 1024:
        raise ValueError(f"--side {options.side}: give 16 to 1024 pixels")
    if options.seed < 0:
        raise ValueError(f"--seed {options.seed}: give a number >= 0")
    from mvitac.data.pack import Pack
    from mvitac.report import contact_sheet
    from mvitac.system.files import check_place, write_atomic

    check_place(out)
    pack = Pack(options.pack)
    found, num_all = contact_sheet.strips(
        pack, options.by, split=options.split, num=options.num, limit=options.limit, seed=options.seed
    )
    if out.suffix.lower() == ".html":
        text = contact_sheet.to_html(pack, found, num_all, side=options.side)
        write_atomic(out, lambda file: file.write(text.encode()))
    else:
        picture = contact_sheet.to_image(pack, found, num_all, side=options.side)
        write_atomic(out, lambda file: picture.save(file, "PNG"))
    Console(markup=False).print(f"{out}: {len(found)} of {num_all} strips", soft_wrap=True, highlight=False)


def export_lerobot(argv: list[str]) -> None:
    """mvitac data export-lerobot PACK --out DIR [--fps 10]"""
    from rich.console import Console
    from tyro.conf import Positional

    from mvitac.data.pack import Pack
    from mvitac.datasets.lerobot.writer import write_lerobot

    @dataclass(frozen=True)
    class Options:
        """A pack as a LeRobotDataset v3: images as they are (PNG), one episode per touch group."""

        pack: Positional[Path]
        """Folder of the pack."""
        out: Path
        """Folder of the new dataset."""
        fps: int = 10
        """Nominal rate of the rows of an episode: a pack knows no time."""

    options = parse(Options, argv, "data export-lerobot")
    pack = Pack(options.pack)
    num = write_lerobot(pack, options.out, fps=options.fps)
    left = f"; {pack.num - num} rows that lack a modality left out" * (num < pack.num)
    Console(markup=False).print(f"{options.out}: {num} frames{left}", soft_wrap=True, highlight=False)
