"""Checks of the table: damaged items, labels, names, classes, leaks between splits, sensors, columns that tell a label."""

import re
import unicodedata
from collections import defaultdict

import numpy as np
from sklearn.metrics.cluster import contingency_matrix

from mvitac.data.checks.finding import Finding, judged, share
from mvitac.data.pack import Pack
from mvitac.data.several import SHARED
from mvitac.data.spec import UNGROUPED, listed

KEYS = ("object", "instance", "recording", "video", "grasp", "experiment", "session", "sequence")
"""Columns whose values should not be in more than one split either, if the dataset has them."""
PACKED = ("label_", "has_", "crc_", "bytes_")  # what the columns that packing adds begin with


def unreadable(pack: Pack) -> Finding:
    damaged = pack.meta.get("damaged", [])
    evidence = f"{len(damaged)}; {pack.num} rows were read" + (f"; first {': '.join(damaged[0])}" if damaged else "")
    advice = "repair them or download them again; the pack does not contain them"
    return judged("unreadable items", evidence, advice, look=bool(damaged), broken=len(damaged) > 0.01 * pack.num)


def missing_images(pack: Pack) -> Finding:
    has = {modality: pack.has(modality) for modality in pack.spec.modalities}
    notes = [f"{share(int((~h).sum()), pack.num)} rows have no {m}" for m, h in has.items() if not h.all()]
    empty = [(split, m) for m, h in has.items() for split in ("train", "test") if not h[pack.rows(split)].any()]
    notes += [f"no row of {split} has {m}" for split, m in empty if len(pack.rows(split))]
    evidence = "; ".join(notes) or f"every row has {' and '.join(has)}"
    advice = "assign splits so that both have both modalities, or leave the modality out"
    return judged("missing images", evidence, advice, look=any(note.startswith("no row") for note in notes))


def labels(pack: Pack) -> list[Finding]:
    """Find rows without a label, classes that are missing in train or test, and uneven classes, per task."""
    findings = []
    for task in pack.spec.tasks:
        item, found = f"labels of {task.name}", [pack.labels(task.name, *s) for s in (("train", "val"), ("test",))]
        train, test = (np.bincount(own[own >= 0], minlength=len(task.classes)) for own in found)
        if not train.any() or not test.any():
            lacking = "test" if train.any() else "train"
            findings.append(judged(item, f"none in {lacking}", "label some or assign the splits again", broken=True))
            continue
        asked = pack.rows("train", "val", "test", only=task.only, by=task.split)
        empty = asked[pack.labels(task.name)[asked] < 0]
        majority, names = test[train.argmax()] / test.sum(), np.array(task.classes)
        unseen, unasked = names[(test > 0) & (train == 0)].tolist(), names[test == 0].tolist()
        uneven = majority > 0.9 or (majority > 0.75 and len(names) > 2)
        always = task.classes[train.argmax()]
        evidence = f"{len(names)} classes; always saying {always!r} scores {100 * majority:.1f} % on test"
        evidence += f"; never tested: {listed(unasked, 3)}" if unasked else ""
        evidence += f"; tested but never seen in training: {listed(unseen, 3)}" if unseen else ""
        if len(empty):
            evidence += f"; {share(len(empty), len(asked))} rows have none, first {pack.column('id')[empty[0]]}"
        advice = ["assign the groups to splits again, or drop the classes"] * bool(unseen or unasked)
        advice += ["fill them in; fine if they are meant for pre-training only"] * bool(len(empty))
        advice += ["report balanced accuracy"] * bool(uneven)
        how = {"look": bool(advice), "broken": bool(unseen)}
        findings.append(judged(item, evidence, "; ".join(advice), empty.tolist(), **how))
    return findings


def sides_of(splits: np.ndarray) -> np.ndarray:
    """Return split names with unlabelled counted as train, because pre-training uses both."""
    return np.where(splits == "unlabelled", "train", splits)


def leaks(pack: Pack) -> list[Finding]:
    """Find groups, touch groups and other keys in more than one split, for the split of each task.

    In a task's own column, rows without its label do not count: they are used neither to train nor to test.
    """
    findings = []
    names = [n for n in ("group", "touch_group", *KEYS) if n in pack.table.column_names]
    for split in pack.spec.split_columns:
        own = [pack.answered(task) for task in pack.spec.all_tasks if task.split == split != "split"]
        counted = np.flatnonzero(np.logical_or.reduce(own)) if own else np.arange(pack.num)
        notes: dict[str, str] = {}
        rows = []
        for name in names:
            there = counted[pack.table.column(name).is_valid().to_numpy()[counted]]  # a part of a mix may lack it
            values, sides = pack.column(name).astype(str)[there], sides_of(pack.column(split).astype(str)[there])
            on = {side: set(values[sides == side].tolist()) for side in np.unique(sides)}
            if both := sorted({v for a in on for b in on if a < b for v in on[a] & on[b]}):
                kind = f" ({pack.spec.group_by})" if name == "group" else ""
                test = on.get("test", set())
                of = f"; {len(test & on.get('train', set()))} of {len(test)} in test are also in train" if test else ""
                num = f"{len(both)} of {len(set(values))}"
                notes[name] = f"{name}{kind}: {num} in more than one split, e.g. {both[0]!r}{of}"
                for one in both[:4]:  # a row of each split, side by side on the sheet
                    mine = np.flatnonzero(values == one)
                    rows += [int(there[mine[sides[mine] == side][0]]) for side in np.unique(sides[mine])]
        item = "groups across splits" if split == "split" else f"groups across column {split}"
        evidence = "; ".join(notes.values()) or f"none of {', '.join(names)} is in more than one split"
        advice = "split by the largest of these keys, or report what test shares with train"
        broken = not notes.keys().isdisjoint(("group", "touch_group"))
        findings.append(judged(item, evidence, advice, rows, look=bool(notes), broken=broken))
    return findings


def noted(pack: Pack) -> list[Finding]:
    """Repeat notes of a table without groups, and of a mix where train of one part and test of another share something."""
    notes = {mark: "; ".join(note for note in pack.spec.notes if mark in note) for mark in (UNGROUPED, SHARED)}
    advice = "pack them with splits that agree, or leave a part out"
    found = [judged("groups", notes[UNGROUPED], "pack again with --group COLUMN")] if notes[UNGROUPED] else []
    return found + ([judged("shared by parts", notes[SHARED], advice, broken=True)] if notes[SHARED] else [])


def _predicts(what: str, task: str, values: np.ndarray, labels: np.ndarray) -> list[str]:
    """Return a note if the most frequent label of each value is right for more rows than the majority class. Ten points
    more, and more than with each of 99 random orders of the values (p = .01)."""

    def right(values: np.ndarray) -> int:
        return contingency_matrix(values, labels, sparse=True).max(1).sum()

    which = np.unique(values, return_inverse=True)[1]  # numbers are sorted faster than names
    rng, told, majority, num = np.random.default_rng(0), right(which), np.bincount(labels).max(), len(labels)
    if told <= majority + 0.1 * num or any(right(rng.permutation(which)) >= told for _ in range(99)):
        return []
    return [f"{what} predicts {task} with {100 * told / num:.0f} % accuracy (majority {100 * majority / num:.0f} %)"]


def give_aways(pack: Pack) -> Finding:
    """Find columns of numbers, and sensors, that predict a label: confounds that a control probe should use.

    On the labelled rows outside test, the accuracy of the most frequent class in each eighth of the values (of each
    sensor, of empty cells) is compared with that of the majority class. Controls are skipped, the label itself is named.
    """
    notes, same, few = [], [], []
    other = {"id", *(task.name for task in pack.spec.tasks), *(c for used in pack.spec.controls.values() for c in used)}
    names = [pack.column(key).astype(str) for key in ("group", "touch_group") if key in pack.table.column_names]
    columns = [name for name in pack.table.column_names if not (name in other or name.startswith(PACKED))]
    columns = [name for name in columns if not any((pack.column(name).astype(str) == one).all() for one in names)]
    for task in pack.spec.tasks:
        found = pack.labels(task.name, "train", "val")
        rows, found = np.flatnonzero(found >= 0), found[found >= 0]
        few += [f"{task.name} has {len(rows)} labelled rows outside test, 64 are needed"] * (len(rows) < 64)
        for name in columns if len(rows) >= 64 else ():
            if name == "sensor":
                notes += _predicts("sensor", task.name, pack.sensors[rows], found)
                continue
            mine = _numbers(pack.column(name)[rows])
            if mine is None or not np.isfinite(mine).any() or len(np.unique(mine)) < 2:
                continue
            if _is_label(mine, found):
                same.append(f"{name} says the same as {task.name}")
                continue
            there = np.isfinite(mine)
            part = np.searchsorted(np.unique(np.quantile(mine[there], np.arange(1, 8) / 8)), mine)
            notes += _predicts(name, task.name, np.where(there, part, -1), found)
    advice = "report them with every score as a control (--controls name=column)"
    item, evidence = "columns that give a label away", "; ".join(notes or ["no sensor and no column of numbers does"])
    if few and len(few) == len(pack.spec.tasks):
        return Finding(item, "not checkable", "; ".join(few))
    return judged(item, "; ".join([evidence, *same, *few]), advice, look=bool(notes))


def _is_label(values: np.ndarray, labels: np.ndarray) -> bool:
    """Return whether the values are few and each has one label only: the label itself, or another name for it."""
    names, numbers = np.unique(values, return_inverse=True)
    one_class = (len(set(labels[numbers == i])) == 1 for i in range(len(names)))
    return len(names) <= 2 * len(np.unique(labels)) and all(one_class)


def _numbers(cells: np.ndarray) -> np.ndarray | None:
    """Return cells as floats, NaN if empty; None if one is no number. 20220319_002026 is a name, though Python reads one."""
    try:
        texts = ("nan" if cell is None or cell == "" else str(cell) for cell in cells)
        return np.array([float("" if "_" in text else text) for text in texts])
    except (TypeError, ValueError):
        return None


def similar_names(pack: Pack) -> Finding:
    """Find groups and classes whose names differ only in Unicode form, case, blanks or leading zeros."""
    columns = [name for name in ("group", "touch_group", *KEYS) if name in pack.table.column_names]
    names = {name: np.unique(pack.column(name).astype(str)).tolist() for name in columns}
    names |= {f"classes of {task.name}": list(task.classes) for task in pack.spec.tasks}
    notes = []
    for where, given in names.items():
        alike: dict[str, list[str]] = defaultdict(list)
        for name in given:
            alike[_key(name)].append(ascii(name))  # shows what looks the same: Unicode forms, non-breaking blanks
        if pairs := [" and ".join(several) for several in alike.values() if len(several) > 1]:
            notes.append(f"{where}: {listed(pairs)}")
    evidence = "; ".join(notes) or "no two groups or classes differ only in case, blanks or zeros"
    advice = "if they mean the same, write them alike and pack again"
    return judged("names that differ in spelling only", evidence, advice, look=bool(notes))


def _key(name: str) -> str:
    """Return ``name`` without case, Unicode variants, invisible signs, blanks next to letters, and leading zeros."""
    text = unicodedata.normalize("NFKC", unicodedata.normalize("NFKC", name).casefold())
    text = "".join(sign for sign in text if unicodedata.category(sign) != "Cf")
    text = re.sub(r"(?<!\d)[\s_]+|[\s_]+(?!\d)", "", text)
    return re.sub(r"(?<![\d.])0+(?=\d)", "", text)
