"""Test rows that a model was trained on: what a run learned from is kept beside it, and compared with what is scored.

    <run>/trained_on.safetensors    for each source i: <i>.ids and <i>.groups, sorted hashes (uint64) of the ids and groups
                                    of the rows trained on, and <i>.images, their images' checksums; its name in the
                                    header. sha256: digest of all

The first source of a run is its own training rows, the next one those of split val that choose its best weights, if it keeps
them. A run that starts from another model's weights adds the sources of that model. A source without rows stands for weights
of which only their owner, or nothing, says what they were trained on. run.json has the digest too: the list is of this run.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import safetensors.numpy

from mvitac.data.pack import Pack
from mvitac.data.row_hashes import known_images, row_hashes, shown_sums, split_leaks
from mvitac.data.spec import MODALITIES
from mvitac.nn.encoders import IMAGENET, SCRATCH
from mvitac.nn.weights import said_trained_on
from mvitac.run import Run, load_run
from mvitac.system.files import SEAL, brief, check_ordinary, digest, write_atomic

FILE, LEARNED = "trained_on.safetensors", "trained_on"  # and the name of its digest in run.json
KEYS = ("ids", "groups", "images")
NOT_SEEN = "copies as JPEG, resized or mirrored are not seen; `mvitac data check PACK OTHER` finds resized ones"
DECLARED = "its owner says: "  # begins the name of a source without rows whose data its owner names
CHOSE = ", whose scores chose the best weights"  # ends the name of a source that only these weights have
UNKNOWN = "unknown"  # a leak that cannot be checked, because nothing says what the run was trained on


@dataclass(frozen=True)
class Source:
    """Rows of a dataset that a model learned from."""

    name: str  # name of the dataset
    ids: np.ndarray  # uint64, sorted: hashes of the rows' ids
    groups: np.ndarray  # uint64, sorted: hashes of the rows' groups
    images: np.ndarray  # uint64, sorted: ``image_sums`` of the rows


def source_of(pack: Pack, rows: np.ndarray, what: str = "") -> Source:
    """The source that pack ``rows`` are; ``what`` ends its name."""
    ids, groups = (np.unique(found[rows]) for found in row_hashes(pack))
    return Source(pack.spec.name + what, ids, groups, shown_sums(pack, rows))


def unknown_source(name: str) -> Source:
    """The source of weights of which nothing says what they were trained on."""
    return Source(name, *(np.zeros(0, np.uint64) for _ in KEYS))


def file_source(file: Path) -> Source:
    """The source of other people's weights: what their owner says of them in the file, or unknown."""
    said = said_trained_on(file)
    return unknown_source(f"{DECLARED}{said}" if said else file.name)


def weights_files(run: Run) -> list[Path]:
    """The files of ``--encoder.weights``, if the run starts from some."""
    weights = dict.fromkeys(run.encoder[m].weights for m in MODALITIES)
    return [Path(name) for name in weights if name not in (IMAGENET, SCRATCH)]


def with_ancestors(own: Source, ancestors: Sequence[Source]) -> list[Source]:
    """``own`` and those of ``ancestors`` that add rows or groups to the ones before them."""
    found = [own]
    for source in ancestors:
        if len(source.ids):
            known = (all(np.isin(getattr(source, key), getattr(o, key)).all() for key in KEYS) for o in found)
        else:
            known = (not len(other.ids) and other.name == source.name for other in found)
        if not any(known):
            found.append(source)
    return found


def write_sources(folder: Path, sources: Sequence[Source]) -> None:
    arrays = {f"{i}.{key}": getattr(source, key) for i, source in enumerate(sources) for key in KEYS}
    arrays[SEAL] = np.frombuffer(bytes.fromhex(sources_digest(sources)), np.uint8)
    data = safetensors.numpy.save(arrays, metadata={str(i): source.name for i, source in enumerate(sources)})
    write_atomic(folder / FILE, lambda file: file.write(data))


def sources_digest(sources: Sequence[Source]) -> str:
    return digest([[source.name, *(getattr(source, key).tolist() for key in KEYS)] for source in sources])


def read_sources(folder: Path, weights: str = "last") -> list[Source] | None:
    """What the ``weights`` of the run in ``folder``, last or best, learned from; None if that is not known."""
    if not (folder / FILE).exists():
        return None
    check_ordinary(folder / FILE)  # a pipe never ends
    try:
        with safetensors.safe_open(folder / FILE, framework="numpy") as file:
            names = file.metadata()
            found = [Source(names[i], *(file.get_tensor(f"{i}.{key}") for key in KEYS)) for i in sorted(names, key=int)]
            if not file.get_tensor(SEAL).tobytes().hex() == sources_digest(found):
                raise ValueError("it does not match its digest")
    except Exception as error:  # safetensors raises several types for damaged files
        raise ValueError(f"{folder / FILE} is damaged ({brief(error)}): copy it again, or re-train") from None
    record = load_run(folder)[1] if (folder / "run.json").exists() else {}
    if record.get(LEARNED, own := sources_digest(found)) != own:
        raise ValueError(f"{folder / FILE} is of another run: copy the one of this run")
    return [source for source in found if weights == "best" or not source.name.endswith(CHOSE)]


class Scored:
    """The rows of a pack that are scored, to be compared with what models learned from."""

    def __init__(self, pack: Pack) -> None:
        self.pack, (self._ids, self._groups) = pack, row_hashes(pack)

    def leak(self, sources: Sequence[Source] | None, rows: np.ndarray, names: Sequence[str] = ()) -> str:
        """Say which of the test ``rows``, and how many of their groups, are in ``sources``; "" if none is.

        A row is in a source by its id, or by any of its images. Where an owner only names the data, that is compared with
        ``names``, by default the pack's. ``UNKNOWN`` if none is in those that are known, but not all are known.
        """
        if sources is None:
            return UNKNOWN
        found, by = [], self.pack.spec.group_by
        for source in sources:
            seen = np.isin(self._ids[rows], source.ids)
            seen[~seen] = known_images(self.pack, rows[~seen], source.images).any(axis=1)
            groups = np.unique(self._groups[rows]) if by != "row" else np.zeros(0)  # a row's number says nothing more
            num_rows, num_groups = int(seen.sum()), int(np.isin(groups, source.groups).sum())
            if num_rows or num_groups:
                grouped = f" and {num_groups} of {len(groups)} test {by}s" if by != "row" else ""
                found.append(f"{num_rows} of {len(rows)} test rows{grouped} were trained on ({source.name})")
        rest = [source.name for source in sources if not len(source.ids)]
        said = [name.removeprefix(DECLARED) for name in rest if name.startswith(DECLARED)]
        declared = dict.fromkeys(declared_leak(text, names or [self.pack.spec.name.split(" (")[0]]) for text in said)
        found += [leak for leak in declared if leak not in ("", UNKNOWN)]
        return "; ".join(found) or (UNKNOWN if len(rest) > len(said) or UNKNOWN in declared else "")


def declared_leak(trained_on: str | None, names: Sequence[str]) -> str:
    """The leak of an encoder whose owner only names what it was trained on, for data of these ``names``.

    ``UNKNOWN`` if the owner does not. Blanks, signs and upper case do not count: "Touch and Go" is "touch-and-go".
    """
    said = [" ".join(_words(part)) for part in (trained_on or "").split(";")]
    asked = {name: " ?".join("".join(_words(name))) for name in names if _words(name)}
    if named := [name for name, letters in asked.items() if any(re.search(rf"\b{letters}\b", part) for part in said)]:
        return f"{named[0]} was in its owner's training, which rows is not known"
    return UNKNOWN if UNKNOWN in said or not any(said) else ""


def _words(text: str) -> list[str]:
    """Words and numbers in lower case: ImageNet1k is "image", "net", "1", "k"."""
    return re.findall(r"[^\W\d_]+|\d+", re.sub("(?<=[a-z])(?=[A-Z])", " ", text).lower())


def leak_mark(leak: str) -> str:
    """What stands beside a score whose test rows, or their groups, were trained on."""
    return {"": "", UNKNOWN: " LEAK?"}.get(leak, " LEAK")


def leaks_of(records: Sequence[dict[str, Any]]) -> list[str]:
    """One line for each source of ``records`` with a leak, or of which it is not known."""
    unknown = "what it or its start weights were trained on is unknown, so leaks cannot be excluded"
    lines = []
    for record in records:
        if record.get("leak") == UNKNOWN:
            lines.append(f"{record['source']}: {unknown}")
        elif record.get("leak"):
            lines.append(f"{record['source']}, {record.get('task') or 'retrieval'}: {record['leak']}")
    return [*dict.fromkeys(lines), *([NOT_SEEN] if lines else [])]


def mark_split_leaks(pack: Pack, records: Sequence[dict[str, Any]]) -> list[str]:
    """A line for each split of which test is in train, too. Marks ``records`` of it, controls too: they gain alike."""
    columns, found = {task.name: task.split for task in pack.spec.all_tasks}, split_leaks(pack, pack.spec.all_tasks)
    said = {}
    for record in records:
        if text := found.get(columns.get(record.get("task", ""), "split")):
            said[text] = None
            record["leak"] = text if record.get("leak", "") in ("", UNKNOWN) else record["leak"]
    return [*said]
