"""``mvitac data ...``: simulate, pack and shard data, and look at what is in a pack."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from tyro.conf import Positional

from mvitac.cli.data_info import groups_text
from mvitac.cli.options import asks_help, console, parse, selectors, short
from mvitac.data.build import build
from mvitac.data.pack import Pack
from mvitac.data.sharding import write_shards
from mvitac.data.spec import Window
from mvitac.datasets.base import DatasetConfig
from mvitac.datasets.lerobot.writer import write_lerobot
from mvitac.datasets.simulated import SimulatedConfig
from mvitac.registry import default, unknown
from mvitac.system.files import check_place, write_atomic


@dataclass(frozen=True, kw_only=True)
class _BuildOptions:
    out: Path
    """Folder of the new pack."""
    data: Annotated[DatasetConfig, tyro.conf.arg(name="")]
    max_damaged: float = 0.0
    """Share of the items that may be unreadable before packing stops; they are listed in pack.json."""
    quiet: bool = False
    """No progress bar."""


def simulate(argv: list[str]) -> None:
    """mvitac data simulate materials|grasps --num ... --size ... --seed ... --out DIR"""
    names = sorted(cls.name for cls in SimulatedConfig.__subclasses__())
    usage = f"mvitac data simulate {'|'.join(names)} --out DIR"
    if not argv or argv[0].startswith("-"):
        if asks_help(argv):
            print(f"usage: {usage}\n\nThe options of one: mvitac data simulate KIND --help")
            return
        raise ValueError(f"name what to simulate: {usage}")
    if argv[0] not in names:
        raise unknown("kind to simulate", argv[0], names)
    _build(default(SimulatedConfig, argv[0]), argv[1:], f"data simulate {argv[0]}")


def pack(argv: list[str]) -> None:
    """mvitac data pack --data NAME ... --out DIR"""
    chosen, rest = selectors(argv, ("--data",))
    if "--data" not in chosen:
        usage = f"mvitac data pack --data {'|'.join(DatasetConfig.choices)} --out DIR"
        if asks_help(rest):
            print(f"usage: {usage}\n\nThe options of one: mvitac data pack --data NAME --help")
            return
        raise ValueError(f"name the dataset: {usage}")
    _build(default(DatasetConfig, chosen["--data"]), short(rest), f"data pack --data {chosen['--data']}")


def _build(config: Any, argv: list[str], prog: str) -> None:
    """Build a pack of ``config``, whose fields are the options."""
    usual = _BuildOptions(out=tyro.MISSING, data=config)
    options = parse(_BuildOptions, argv, prog, default=usual, description=type(config).__doc__ or "")
    check_place(options.out)
    data: Any = options.data
    if data.frame_window() != Window():
        raise ValueError(
            "a pack stores every frame once, so options of windows (--num-frames, --stride, ...) have no effect here:"
            " leave them out, and give them to the commands that read the pack"
        )
    pack = build(
        data.source(),
        options.out,
        size=data.size,
        workers=data.workers,
        store=data.store,
        quality=data.quality,
        max_damaged=options.max_damaged,
        quiet=options.quiet,
    )
    print(f"{pack.path}: {pack.num} samples at {pack.size} px")
    if lost := pack.meta["damaged"]:
        first = ": ".join(lost[0])
        print(f'{len(lost)} left out, listed under "damaged" in {pack.path / "pack.json"}; first {first}')
    console(None).print(groups_text(pack))
    for note in pack.spec.notes:
        print(f"note: {note}")


@dataclass(frozen=True)
class _SheetOptions:
    """A picture of everything a simulator makes, to check by eye."""

    kind: Positional[Literal["materials", "grasps"]]
    """Which simulator."""
    out: Path | None = None
    """The picture (default: KIND.png here)."""
    seed: int = 0
    """World seed."""
    side: int = 72
    """Height of a picture in pixels."""


def sheet(argv: list[str]) -> None:
    """mvitac data sheet materials|grasps [--out FILE.png]"""
    options = parse(_SheetOptions, argv, "data sheet")
    from mvitac.report.simulated_sheet import grasps_sheet, materials_sheet

    draw = {"materials": materials_sheet, "grasps": grasps_sheet}[options.kind]
    out = options.out or Path(f"{options.kind}.png")
    if out.suffix.lower() != ".png":
        raise ValueError(f"--out {out}: the sheet is a PNG, give a name that ends in .png")
    if options.seed < 0:
        raise ValueError(f"--seed {options.seed}: give a number >= 0")
    picture = draw(options.seed, options.side)
    write_atomic(out, lambda file: picture.save(file, "PNG"))
    print(out)


@dataclass(frozen=True)
class _ShardOptions:
    """A pack in shards, for data larger than a machine's memory or disk: shards are read whole and in sequence.

    mvitac data shard PACK s3://bucket/path

    mvitac pretrain --data stream --data.url s3://bucket/path --data.cache /scratch/cache --data.cache-gb 50 ...

    Rows of one touch stay together, touches come in random order. An interrupted shard is written again.
    """

    pack: Positional[Path]
    """Folder of the pack."""
    url: Positional[str]
    """Where the shards go: a folder, file:///..., s3://bucket/path (needs mvitac[s3]), or any other URL that fsspec
    opens."""
    shard_mb: float = 64
    """Maximum size of a shard in megabytes of images, camera and touch together."""
    seed: int = 0
    """Seed of the order of the touches."""
    quiet: bool = False
    """No progress bar."""


def shard(argv: list[str]) -> None:
    """mvitac data shard PACK URL [--shard-mb 64]"""
    options = parse(_ShardOptions, argv, "data shard")
    pack = Pack(options.pack)
    num = write_shards(pack, options.url, shard_mb=options.shard_mb, seed=options.seed, quiet=options.quiet)
    print(f"{options.url}: {pack.num} samples in {num} shards")


@dataclass(frozen=True)
class _LeRobotOptions:
    """A pack as a LeRobotDataset v3: images unchanged (PNG), one episode per touch group."""

    pack: Positional[Path]
    """Folder of the pack."""
    out: Path
    """Folder of the new dataset."""
    fps: int = 10
    """Nominal rate of the rows of an episode: a pack holds no times."""


def export_lerobot(argv: list[str]) -> None:
    """mvitac data export-lerobot PACK --out DIR [--fps 10]"""
    options = parse(_LeRobotOptions, argv, "data export-lerobot")
    pack = Pack(options.pack)
    num = write_lerobot(pack, options.out, fps=options.fps)
    left = f"; {pack.num - num} rows that lack a modality left out" * (num < pack.num)
    print(f"{options.out}: {num} frames{left}")
