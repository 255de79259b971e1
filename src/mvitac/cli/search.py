"""``mvitac embed`` and ``find``: embeddings of whole packs, and the nearest of them.

What needs torch is imported after the options are parsed, so that --help is quick.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro
from tabulate import tabulate
from tyro.conf import Positional

from mvitac.cli.options import check_json, check_models, loading, parse, printed_to, save_json
from mvitac.data.images import decode, fit, side_by_side
from mvitac.data.pack import Pack
from mvitac.report.contact_sheet import draw
from mvitac.system.files import write_atomic
from mvitac.system.progress import shown

_SIDE = 160  # pixels: side of one picture of what was found


@dataclass(frozen=True, kw_only=True)
class _EmbedOptions:
    """Embeddings of every row of a pack, with ids, groups, splits and labels; NaN where a row lacks the image."""

    pack: Positional[Path]
    """Folder of the pack, with images of the model's size."""
    model: str
    """Folder of a run or an artifact, or owner/name on the Hub."""
    out: Path
    """The parquet file."""
    shared: bool = False
    """Unit vectors of the space that both modalities share, where touch finds vision, instead of features."""


def embed(argv: list[str]) -> None:
    options = parse(_EmbedOptions, argv, "embed")
    check_models(options.model)
    loading()
    from mvitac.deploy.artifact import load
    from mvitac.deploy.search import embed
    from mvitac.evaluation.evaluate import as_trained
    from mvitac.evaluation.sensors import about_new

    check_json(options.out, "--out")
    model = load(options.model)
    pack = as_trained(model, Pack(options.pack))
    with shown():
        table = embed(model, pack, options.out, shared=options.shared)
    seen = " and ".join(m for m in model.encoders if m in table.column_names)
    print(f"{options.out}: {table.num_rows} rows of {seen}")
    if new := about_new(model, pack):
        print(new)


@dataclass(frozen=True, kw_only=True)
class _FindOptions:
    """The nearest known pairs to a picture, by exact cosine."""

    image: Positional[tuple[Path, ...]]
    """Picture files; a two-sensor touch is two files, left then right."""
    model: str
    """The model that embedded the pairs."""
    known: Path
    """File of mvitac embed; --shared, if touch is to find vision."""
    source: Annotated[Literal["touch", "vision"], tyro.conf.arg(name="from")] = "touch"
    """Modality of the picture."""
    target: Annotated[Literal["touch", "vision"] | None, tyro.conf.arg(name="to")] = None
    """Modality to compare it with. Default: the other one, if the model has it."""
    background: tuple[Path, ...] = ()
    """For a model of difference images: the touch sensor without contact, as many files as the picture. Without it the
    picture must be a difference image already."""
    num: int = 5
    """How many to find."""
    json: Path | None = None
    """Also write what was found to this file; - = stdout, and the table to stderr."""
    sheet: Path | None = None
    """Also draw the query and what was found, side by side, into this PNG (needs the pack at its old path)."""


def find(argv: list[str]) -> None:
    options = parse(_FindOptions, argv, "find")
    check_models(options.model)
    loading()
    from mvitac.deploy.artifact import load
    from mvitac.deploy.search import Embeddings

    if not options.image:
        raise ValueError("name the picture to search for: mvitac find IMAGE --model M --known FILE")
    check_json(options.json)
    check_json(options.sheet, "--sheet")
    if not options.known.is_file():
        raise ValueError(f"no file {options.known}: write it with mvitac embed")
    model = load(options.model)
    known = Embeddings(options.known, model.weights_digest())
    if (frames := model.spec.frames(options.source)) > 1:
        raise ValueError(f"{options.model} looks at {frames} frames: find takes one picture, search in Python instead")
    if len(options.image) != (num := model.spec.channels(options.source) // 3):
        raise ValueError(f"{options.model} looks at {num} images of {options.source}: {len(options.image)} are given")
    target = options.target or next((m for m in model.encoders if m != options.source), options.source)
    query, background = _picture(options.image), _picture(options.background) if options.background else None
    rows, cosines = known.find(model, query, options.source, target, options.num, background=background)
    found = []
    for row, cosine in zip(rows[0].tolist(), cosines[0], strict=True):
        about = {name: known.table.column(name)[row].as_py() for name in ("id", "group", "row")}
        found.append({"cosine": round(float(cosine), 6), **about, "labels": known.labels(row)})
    lines = [[f"{o['cosine']:.3f}", o["id"], o["group"], *map(o["labels"].get, known.classes)] for o in found]
    table = tabulate(lines, ["cosine", "id", "group", *known.classes], disable_numparse=True)
    title = f"{options.source} -> {target} in {options.known}"
    print(title, table, "", sep="\n", file=printed_to(options.json))
    save_json(options.json, {"from": options.source, "to": target, "found": found})
    if options.sheet:
        pack = Pack(known.pack, verify=False)
        if pack.digest != known.pack_digest:
            raise ValueError(f"{pack.path} is another pack than the one that was embedded: embed it again")
        if any(one["row"] not in range(pack.num) or pack.own_ids[one["row"]] != one["id"] for one in found):
            raise ValueError(f"{options.known}: its ids are not those of its rows in {pack.path}: embed it again")
        tiles = [(pack.images[target][one["row"]], f"{one['cosine']:.3f} {one['id']}") for one in found]
        blocks = [("query", [(query, "")]), ("found", tiles)]
        sheet = draw(title, [(name, [(side_by_side(fit(x, _SIDE)), t) for x, t in some]) for name, some in blocks])
        write_atomic(options.sheet, lambda file: sheet.save(file, "PNG"))
        print(f"written: {options.sheet}", file=printed_to(options.json))


def _picture(files: Sequence[Path]) -> np.ndarray:
    """One RGB picture [H, W, 3 x files]: the files stacked in channels, as ``data pack`` reads and stacks them."""
    return np.concatenate([np.asarray(decode(file)) for file in files], axis=2)
