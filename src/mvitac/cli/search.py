"""``mvitac embed``, ``index`` and ``find``: embeddings of whole packs, and the nearest of them."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from tyro.conf import Positional

from mvitac.cli.options import parse

if TYPE_CHECKING:
    import numpy as np


@dataclass(frozen=True, kw_only=True)
class _Embedding:
    pack: Positional[Path]
    """Folder of the pack."""
    model: str
    """A run's or an artifact's folder, or owner/name on the Hub."""


def embed(argv: list[str]) -> None:
    """mvitac embed PACK --model M --out FILE.npz|FILE.parquet"""
    import numpy as np
    import pyarrow as pa
    import pyarrow.parquet as pq
    from rich.console import Console

    from mvitac.data.pack import Pack
    from mvitac.deploy.artifact import load
    from mvitac.deploy.search import check_pack, describe, embeddings
    from mvitac.system.files import check_place, write_atomic
    from mvitac.system.progress import shown

    @dataclass(frozen=True, kw_only=True)
    class Options(_Embedding):
        """Embeddings of every row of a pack, with ids, groups, splits and labels; NaN where a row lacks the image."""

        out: Path
        """The file: .npz (numpy) or .parquet."""
        shared: bool = False
        """The unit vectors of the space that both modalities share, instead of features."""

    options = parse(Options, argv, "embed")
    if options.out.suffix not in (".npz", ".parquet"):
        raise ValueError(f"--out {options.out}: give a name that ends in .npz or .parquet")
    check_place(options.out)
    model, pack = load(options.model), Pack(options.pack)
    table = describe(pack, np.arange(pack.num))
    found = {}
    for m in check_pack(model, pack):
        rows = np.flatnonzero(pack.has(m))
        with shown(Console(stderr=True)):
            x = np.concatenate(list(embeddings(model, pack, m, rows, shared=options.shared)))
        found[m] = np.full((pack.num, x.shape[1]), np.nan, np.float32)
        found[m][rows] = x
    if options.out.suffix == ".npz":
        columns = {name: np.array(table.column(name).to_pylist()) for name in table.column_names}
        write_atomic(options.out, lambda file: np.savez(file, **columns, **found))  # type: ignore[arg-type]
    else:
        for m, x in found.items():
            table = table.append_column(m, pa.FixedSizeListArray.from_arrays(x.reshape(-1), x.shape[1]))
        write_atomic(options.out, lambda file: pq.write_table(table, file))
    shapes = ", ".join(f"{m} {x.shape}" for m, x in found.items())
    Console(markup=False).print(f"{options.out}: {shapes}", soft_wrap=True, highlight=False)


def index(argv: list[str]) -> None:
    """mvitac index PACK --model M --out DIR"""
    from rich.console import Console

    from mvitac.data.pack import Pack
    from mvitac.deploy.artifact import load
    from mvitac.deploy.search import build
    from mvitac.system.progress import shown

    @dataclass(frozen=True, kw_only=True)
    class Options(_Embedding):
        """Index the pairs of a pack, to find the nearest known touches and pictures with mvitac find."""

        out: Path
        """The new folder."""
        splits: tuple[str, ...] = ()
        """Only these splits (train, val, test, unlabelled); none given = all."""

    options = parse(Options, argv, "index")
    with shown(Console(stderr=True)):
        made = build(load(options.model), Pack(options.pack), options.out, options.splits)
    shapes = ", ".join(f"{m} {bank.shape}" for m, bank in made.banks.items())
    Console(markup=False).print(
        f"{options.out}: {shapes}, space: {made.meta['space']}", soft_wrap=True, highlight=False
    )


def _picture(files: Sequence[Path]) -> "np.ndarray":
    """One RGB picture [H, W, 3 x files], the files' side by side in channels at the first one's size."""
    import numpy as np
    from PIL import Image

    from mvitac.system.files import brief

    parts: list[Image.Image] = []
    for file in files:
        try:
            with Image.open(file) as opened:
                parts.append(opened.convert("RGB"))
        except Exception as error:  # Pillow has a kind for each damage
            raise ValueError(f"{file} cannot be read as a picture ({brief(error)}): give another") from None
    return np.concatenate([np.asarray(p.resize(parts[0].size)) for p in parts], axis=2)


def find(argv: list[str]) -> None:
    """mvitac find IMAGE --in INDEX [--from touch] [--to vision]"""
    from typing import Annotated, Literal

    import numpy as np
    import tyro
    from PIL import Image
    from rich.console import Console
    from rich.table import Table

    from mvitac.data.pack import Pack
    from mvitac.deploy.search import Index
    from mvitac.system.files import check_place, write_atomic

    @dataclass(frozen=True, kw_only=True)
    class Options:
        """The nearest known pairs to a picture, by exact cosine in the space that vision and touch share."""

        image: Positional[tuple[Path, ...]]
        """Picture files; a two-sensor touch is two files, left then right."""
        index: Annotated[Path, tyro.conf.arg(name="in")]
        """Folder of the index."""
        source: Annotated[Literal["touch", "vision"], tyro.conf.arg(name="from")] = "touch"
        """What the picture is."""
        target: Annotated[Literal["touch", "vision"], tyro.conf.arg(name="to")] = "vision"
        """What to compare it with."""
        background: tuple[Path, ...] = ()
        """For a model of difference images: the touch sensor without contact, as many files as the picture. Without it the
        picture is a difference image already."""
        k: int = 5
        """How many to find."""
        picture: Path | None = None
        """Also draw the query and what was found into this PNG (needs the indexed pack where it was)."""

    options = parse(Options, argv, "find")
    if not options.image:
        raise ValueError("say what to find: mvitac find IMAGE --in INDEX")
    if options.picture:
        check_place(options.picture)
    index = Index(options.index)
    model = index.model()
    query = _picture(options.image)
    free = _picture(options.background) if options.background else None
    rows, scores = index.find(model, query, options.source, options.target, options.k, background=free)
    table = Table(title=f"{options.source} -> {options.target} in {options.index}", title_justify="left")
    for column in ("cosine", "id", "group", *index.meta["classes"]):
        table.add_column(column)
    for row, score in zip(rows[0].tolist(), scores[0], strict=True):
        labels = index.labels(row)
        own = [str(index.table.column(name)[row]) for name in ("id", "group")]
        table.add_row(f"{score:.3f}", *own, *(labels.get(task, "") for task in index.meta["classes"]))
    Console(markup=False).print(table)
    if options.picture:
        pack = Pack(index.meta["pack"], verify=False)
        if pack.digest != index.meta["pack_digest"]:
            raise ValueError(f"{pack.path} is another pack than the one that was indexed: index it again")
        side = 160
        sheet = Image.new("RGB", (side * (len(rows[0]) + 1), side), "white")
        tiles = [query, *(pack.images[options.target][index.table.column("row")[r].as_py()] for r in rows[0].tolist())]
        for i, tile in enumerate(tiles):
            sheet.paste(
                Image.fromarray(np.ascontiguousarray(tile[..., :3])).resize((side - 4, side - 4)), (i * side, 2)
            )
        write_atomic(options.picture, lambda file: sheet.save(file, "PNG"))
