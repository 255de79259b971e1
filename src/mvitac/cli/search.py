"""``mvitac embed``, ``index`` and ``find``: embeddings of whole packs, and the nearest of them.

What needs torch is imported after the options are parsed, so that --help is quick.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import tyro
from tabulate import tabulate
from tyro.conf import Positional

from mvitac.cli.options import check_json, parse, printed_to, save_json
from mvitac.data.image_grid import GAP, Block, Tile, draw, side_by_side
from mvitac.data.images import decode, fit
from mvitac.data.pack import Pack
from mvitac.report.palette import colour
from mvitac.system.files import check_place, write_atomic
from mvitac.system.progress import shown

if TYPE_CHECKING:
    from mvitac.deploy.search import Index

_SIDE = 160  # pixels: side of one picture in the sheet of what was found


@dataclass(frozen=True, kw_only=True)
class _Embedding:
    pack: Positional[Path]
    """Folder of the pack."""
    model: str
    """Folder of a run or an artifact, or owner/name on the Hub."""


@dataclass(frozen=True, kw_only=True)
class _EmbedOptions(_Embedding):
    """Embeddings of every row of a pack, with ids, groups, splits and labels; NaN where a row lacks the image."""

    out: Path
    """The file: .npz (numpy) or .parquet."""
    shared: bool = False
    """Unit vectors of the space that both modalities share, instead of features."""


def embed(argv: list[str]) -> None:
    """mvitac embed PACK --model M --out FILE.npz|FILE.parquet"""
    options = parse(_EmbedOptions, argv, "embed")
    from mvitac.deploy.artifact import load
    from mvitac.deploy.search import check_pack, describe, embeddings
    from mvitac.evaluation.evaluate import as_trained
    from mvitac.evaluation.sensors import about_new

    if options.out.suffix not in (".npz", ".parquet"):
        raise ValueError(f"--out {options.out}: give a name that ends in .npz or .parquet")
    check_place(options.out)
    model = load(options.model)
    pack, found = as_trained(model, Pack(options.pack)), {}
    for m in check_pack(model, pack):
        rows = np.flatnonzero(pack.has(m))
        with shown():
            x = np.concatenate(list(embeddings(model, pack, m, rows, shared=options.shared)))
        found[m] = np.full((pack.num, x.shape[1]), np.nan, np.float32)
        found[m][rows] = x
    _write(options.out, describe(pack, np.arange(pack.num)), found)
    print(f"{options.out}: {', '.join(f'{m} {x.shape}' for m, x in found.items())}")
    if new := about_new(model, pack):
        print(new)


def _write(out: Path, table: pa.Table, found: dict[str, np.ndarray]) -> None:
    """Embeddings [N, D] by modality beside ``table``, as .npz or .parquet."""
    if out.suffix == ".npz":
        columns = {name: np.array(table.column(name).to_pylist()) for name in table.column_names}
        write_atomic(out, lambda file: np.savez(file, **columns, **found))  # type: ignore[arg-type]
        return
    for m, x in found.items():
        table = table.append_column(m, pa.FixedSizeListArray.from_arrays(x.reshape(-1), x.shape[1]))
    write_atomic(out, lambda file: pq.write_table(table, file))


@dataclass(frozen=True, kw_only=True)
class _IndexOptions(_Embedding):
    """Index the pairs of a pack, to find the nearest known touches and pictures with mvitac find."""

    out: Path
    """The new folder."""
    splits: tuple[str, ...] = ()
    """Only these splits (train, val, test, unlabelled); none given = all."""


def index(argv: list[str]) -> None:
    """mvitac index PACK --model M --out DIR"""
    options = parse(_IndexOptions, argv, "index")
    from mvitac.deploy.artifact import load
    from mvitac.deploy.search import build
    from mvitac.evaluation.evaluate import as_trained

    with shown():
        model = load(options.model)
        made = build(model, as_trained(model, Pack(options.pack)), options.out, options.splits)
    shapes = ", ".join(f"{m} {bank.shape}" for m, bank in made.banks.items())
    print(f"{options.out}: {shapes}, space: {made.meta['space']}")


@dataclass(frozen=True, kw_only=True)
class _FindOptions:
    """The nearest known pairs to a picture, by exact cosine in the space that vision and touch share."""

    image: Positional[tuple[Path, ...]]
    """Picture files; a two-sensor touch is two files, left then right."""
    index: Annotated[Path, tyro.conf.arg(name="in")]
    """Folder of the index."""
    source: Annotated[Literal["touch", "vision"], tyro.conf.arg(name="from")] = "touch"
    """Modality of the picture."""
    target: Annotated[Literal["touch", "vision"], tyro.conf.arg(name="to")] = "vision"
    """Modality to compare it with."""
    background: tuple[Path, ...] = ()
    """For a model of difference images: the touch sensor without contact, as many files as the picture. Without it the
    picture must be a difference image already."""
    k: int = 5
    """How many to find."""
    json: Path | None = None
    """Also write what was found to this file; - = stdout, and the table to stderr."""
    picture: Path | None = None
    """Also draw the query and what was found into this PNG (needs the indexed pack at its old path)."""


def find(argv: list[str]) -> None:
    """mvitac find IMAGE --in INDEX [--from touch] [--to vision] [--json FILE]"""
    options = parse(_FindOptions, argv, "find")
    from mvitac.deploy.search import Index

    if not options.image:
        raise ValueError("name the picture to search for: mvitac find IMAGE --in INDEX")
    check_json(options.json)
    if options.picture:
        check_place(options.picture)
    index = Index(options.index)
    query = _picture(options.image)
    background = _picture(options.background) if options.background else None
    rows, scores = index.find(index.model(), query, options.source, options.target, options.k, background=background)
    found = [
        {
            "cosine": round(float(score), 6),
            **{name: str(index.table.column(name)[row]) for name in ("id", "group")},
            "row": index.table.column("row")[row].as_py(),
            "labels": index.labels(row),
        }
        for row, score in zip(rows[0].tolist(), scores[0], strict=True)
    ]
    title = f"{options.source} -> {options.target} in {options.index}"
    tasks = index.meta["classes"]
    rows = [[f"{o['cosine']:.3f}", o["id"], o["group"], *(o["labels"].get(task, "") for task in tasks)] for o in found]
    table = tabulate(rows, ["cosine", "id", "group", *tasks], disable_numparse=True)
    print(title, table, "", sep="\n", file=printed_to(options.json))
    save_json(options.json, {"from": options.source, "to": options.target, "found": found})
    if options.picture:
        _draw(options.picture, query, index, options, found)


def _picture(files: Sequence[Path]) -> np.ndarray:
    """One RGB picture [H, W, 3 x files]: the files stacked in channels, as ``data pack`` reads and stacks them."""
    parts = [np.asarray(decode(file)) for file in files]
    for file, part in zip(files, parts, strict=True):
        if part.shape != parts[0].shape:
            (h, w), (h2, w2) = parts[0].shape[:2], part.shape[:2]
            raise ValueError(f"{files[0]} is {w} x {h}, {file} is {w2} x {h2}: stacked sensors need one size")
    return np.concatenate(parts, axis=2)


def _draw(out: Path, query: np.ndarray, index: "Index", options: _FindOptions, found: Sequence[dict[str, Any]]) -> None:
    """A PNG of the query and of what was ``found`` in the indexed pack, side by side."""
    pack = Pack(index.meta["pack"], verify=False)
    if pack.digest != index.meta["pack_digest"]:
        raise ValueError(f"{pack.path} is another pack than the one that was indexed: index it again")
    tiles = [Tile(side_by_side(fit(query, _SIDE)), f"query: {options.source}", colour("blue"))]
    for number, one in enumerate(found, 1):
        image = side_by_side(fit(np.asarray(pack.images[options.target][one["row"]]), _SIDE))
        caption = f"{number}. cosine {one['cosine']:.2f}: {', '.join(one['labels'].values())}, {one['id']}"
        tiles.append(Tile(image, caption))
    title = f"The nearest {options.target} images to a {options.source} image"
    sheet = draw(title, [Block("", tiles)], width=(len(tiles) + 1) * (_SIDE + GAP))
    write_atomic(out, lambda file: sheet.save(file, "PNG"))
