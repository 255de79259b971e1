"""Checks of the table: damaged items, labels, classes, leaks between splits, sensors, numbers, published counts."""

from collections.abc import Iterator

import numpy as np

from mvitac.data.checks.finding import Finding, Verdict, share, some
from mvitac.data.pack import Pack
from mvitac.data.pack_table import SPLITS
from mvitac.data.source import Count
from mvitac.data.spec import UNGROUPED

KEYS = ("object", "instance", "recording", "video", "grasp", "experiment", "session", "sequence")
"""Columns whose values should not be in more than one split either, if the dataset has them."""
MIX = ("sensor", "vision_size", "touch_size")  # columns that describe how an image was taken


def unreadable(pack: Pack) -> Finding:
    """List items that packing could not read."""
    damaged = pack.meta.get("damaged", [])
    if not damaged:
        return Finding("unreadable items", "ok", f"none; {pack.num} rows were read")
    verdict: Verdict = "broken" if len(damaged) > 0.01 * pack.num else "look"
    evidence = f"{len(damaged)}; {pack.num} rows were read; first {': '.join(damaged[0])}"
    advice = "repair them or download them again; the pack does not contain them"
    return Finding("unreadable items", verdict, evidence, advice)


def missing_images(pack: Pack) -> Finding:
    """Count rows without an image of a modality that the dataset has."""
    notes = []
    verdict: Verdict = "ok"
    for modality in pack.spec.modalities:
        lacking = ~pack.has(modality)
        if lacking.any():
            notes.append(f"{share(int(lacking.sum()), pack.num)} rows have no {modality}")
        for split in ("train", "test"):
            if len(rows := pack.rows(split)) and lacking[rows].all():
                verdict = "look"
                notes.append(f"no row of {split} has {modality}")
    evidence = "; ".join(notes) or f"every row has {' and '.join(pack.spec.modalities)}"
    advice = "assign splits so that both have both modalities, or leave the modality out" if verdict != "ok" else ""
    return Finding("missing images", verdict, evidence, advice)


def missing_labels(pack: Pack) -> Finding:
    """Find rows of train, val and test without a label of their task."""
    item, notes, rows = "missing labels", [], []
    verdict: Verdict = "ok"
    if not pack.spec.tasks:
        return Finding(item, "ok", "no tasks: nothing to label")
    for task in pack.spec.tasks:
        labels = pack.column(f"label_{task.name}")
        for split in ("train", "val", "test"):
            asked = pack.rows(split, only=task.only, by=task.split)
            empty = asked[labels[asked] < 0]
            if len(asked) == len(empty) and split != "val":
                verdict = "broken"
                notes.append(f"{task.name}: no labelled rows in {split}")
            elif len(empty):
                verdict = "look" if verdict == "ok" else verdict
                notes.append(
                    f"{task.name}: {share(len(empty), len(asked))} in {split}, first {pack.column('id')[empty[0]]}"
                )
                rows += empty.tolist()
    advice = "fill them in, or move the rows to split unlabelled; fine if they are meant for pre-training only"
    evidence = "; ".join(notes) or "none in train, val and test"
    return Finding(item, verdict, evidence, advice if notes else "", rows)


def class_balance(pack: Pack) -> list[Finding]:
    """Find classes that are missing in train or test, and the accuracy of a constant answer, per task."""
    findings = []
    for task in pack.spec.tasks:
        counts = {}
        for side, splits in (("train", ("train", "val")), ("test", ("test",))):
            found = pack.labels(task.name, *splits)
            counts[side] = np.bincount(found[found >= 0], minlength=len(task.classes))
        item = f"classes of {task.name}"
        if not counts["train"].sum() or not counts["test"].sum():
            findings.append(Finding(item, "not checkable", "no labels in train or test"))
            continue
        majority = counts["test"][counts["train"].argmax()] / counts["test"].sum()
        unseen = [c for i, c in enumerate(task.classes) if counts["test"][i] and not counts["train"][i]]
        unasked = [c for i, c in enumerate(task.classes) if not counts["test"][i]]
        name = task.classes[counts["train"].argmax()]
        evidence = f"{len(task.classes)} classes; always saying {name!r} scores {100 * majority:.1f} % on test"
        verdict: Verdict = "ok"
        advice = ""
        if unasked:
            verdict, advice = "look", "name the tested classes in every result, or assign the groups to splits again"
            evidence += f"; never tested: {some(unasked)}"
        if majority > 0.9 or (majority > 0.75 and len(task.classes) > 2):
            verdict, advice = "look", "report balanced accuracy as well"
        if unseen:
            verdict = "broken"
            advice = "these cannot be learned: assign the groups to splits again, or drop the classes"
            evidence += f"; tested but never seen in training: {some(unseen)}"
        findings.append(Finding(item, verdict, evidence, advice))
    return findings


def sides_of(splits: np.ndarray) -> np.ndarray:
    """Return split names with unlabelled counted as train, because pre-training uses both."""
    return np.where(splits == "unlabelled", "train", splits)


def split_columns(pack: Pack) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """Yield (name, rows that count, their splits) of ``split`` and of each other column of split names (folds).

    In a task's own column, rows without its label do not count: they are used neither to train nor to test.
    """
    for name in pack.table.column_names:
        values = pack.column(name)
        if values.dtype == object and set(np.unique(values.astype(str))) <= set(SPLITS):
            own = [pack.column(f"label_{task.name}") >= 0 for task in pack.spec.tasks if task.split == name != "split"]
            rows = np.flatnonzero(np.logical_or.reduce(own)) if own else np.arange(pack.num)
            sides = sides_of(values.astype(str)[rows])
            if name == "split" or len(np.unique(sides)) > 1:
                yield name, rows, sides


def leaks(pack: Pack) -> list[Finding]:
    """Find groups, touch groups and other keys in more than one split, per split column. Correct folds are one finding."""
    findings, sound = [], []
    names = [n for n in ("group", "touch_group", *KEYS) if n in pack.table.column_names]
    for split, counted, sides in split_columns(pack):
        verdict: Verdict = "ok"
        notes, rows = [], []
        for name in names:
            values = pack.column(name).astype(str)[counted]
            on = {side: set(values[sides == side].tolist()) for side in np.unique(sides)}
            both = sorted({v for a in on for b in on if a < b for v in on[a] & on[b]})
            if both:
                verdict = "broken" if name in ("group", "touch_group") else "look" if verdict == "ok" else verdict
                kind = f" ({pack.spec.group_by})" if name == "group" else ""
                test = on.get("test", set())
                of = f"; {len(test & on.get('train', set()))} of {len(test)} in test are also in train" if test else ""
                num = f"{len(both)} of {len(set(values))}"
                notes.append(f"{name}{kind}: {num} in more than one split, e.g. {both[0]!r}{of}")
                for one in both[:4]:  # a row of each split, side by side on the sheet
                    mine = np.flatnonzero(values == one)
                    rows += [int(counted[mine[sides[mine] == side][0]]) for side in np.unique(sides[mine])]
        if split != "split" and not notes:
            sound.append(split)
            continue
        item = "groups across splits" if split == "split" else f"groups across column {split}"
        evidence = "; ".join(notes) or f"none of {', '.join(names)} is in more than one split"
        advice = bool(notes) * "split by the largest of these keys, or report what test shares with train"
        findings.append(Finding(item, verdict, evidence, advice, rows))
    if sound:
        evidence = f"{some(sound, 8)}: none of {', '.join(names)} is in more than one split"
        findings.append(Finding("groups across split columns", "ok", evidence))
    return findings


def ungrouped(pack: Pack) -> list[Finding]:
    """Repeat the note of a table that was packed without groups; [] with groups."""
    notes = [note for note in pack.spec.notes if UNGROUPED in note]
    return [Finding("groups", "look", "; ".join(notes), "pack again with --group COLUMN")] if notes else []


def mixture(pack: Pack) -> Finding:
    """Find several sensors or resolutions, and whether they alone predict a label."""
    columns = [name for name in MIX if name in pack.table.column_names]
    verdict: Verdict = "ok"
    notes = []
    for column in columns:
        values = pack.column(column).astype(str)
        names, counts = np.unique(values[values != "None"], return_counts=True)  # None: rows without this image
        if len(names) == 1:
            notes.append(f"{column}: {names[0]}")
            continue
        order = np.argsort(-counts)
        notes.append(f"{column}: {some([f'{names[i]} {100 * counts[i] / pack.num:.0f} %' for i in order], 4)}")
        if column.endswith("_size"):
            verdict = "look"
        on = {split: set(values[pack.rows(split)].tolist()) for split in ("train", "test")}
        if alone := sorted(on["test"] - on["train"]):
            verdict = "look"
            notes.append(f"{column} {some(alone)} only in test")
        for task in pack.spec.tasks:
            labels = pack.labels(task.name, "train", "val", "test")
            counted = (labels >= 0) & (values != "None")
            if told := _predicts(f"{column} alone", task.name, values[counted], labels[counted]):
                verdict = "look"
                notes += told
    if not columns:
        lacking = "no column sensor, and a pack holds one size: check the source with --data instead"
        return Finding("sensors and resolutions", "not checkable", lacking)
    advice = "probe each kind separately, or use the same kinds in train and test" if verdict != "ok" else ""
    return Finding("sensors and resolutions", verdict, "; ".join(notes), advice)


def _predicts(what: str, task: str, values: np.ndarray, labels: np.ndarray) -> list[str]:
    """Return a note if answering the most frequent label of each value is better than the majority class."""
    if not len(labels):
        return []
    majority = np.bincount(labels).max() / len(labels)
    told = sum(np.bincount(labels[values == one]).max() for one in np.unique(values)) / len(labels)
    if told <= majority + 0.1:
        return []
    return [f"{what} predicts {task} with {100 * told:.0f} % accuracy (majority {100 * majority:.0f} %)"]


def numbers(pack: Pack) -> Finding:
    """Find numeric columns with gaps, infinities or extreme outliers."""
    notes, rows, seen = [], [], 0
    targets = {target.name for task in pack.spec.values for target in task.targets}  # these have a check of their own
    for name, values in numeric_columns(pack):
        if name in targets:
            continue
        seen += 1
        bad = ~np.isfinite(values)
        if bad.any() and not bad.all():
            notes.append(
                f"{name} is not a number in {share(int(bad.sum()), len(values))}, first row {np.flatnonzero(bad)[0]}"
            )
            rows += np.flatnonzero(bad).tolist()
        good = values[~bad]
        if len(good) >= 8:
            low, middle, high = np.percentile(good, [5, 50, 95])
            values_far = np.abs(np.where(bad, middle, values) - middle) > 100 * (high - low)
            far = np.flatnonzero(values_far) if high > low else []
            if len(far):
                notes.append(f"{name} is {values[far[0]]:g} in row {far[0]}, others {low:g} to {high:g}")
                rows += list(far)
    if not notes:
        return Finding("numbers", "ok", f"{seen} columns, all finite and in range")
    return Finding("numbers", "look", "; ".join(notes), "repair the cells, or leave the rows out", rows)


def give_aways(pack: Pack) -> Finding:
    """Find numeric columns that predict a label: confounds that a control probe should use.

    On the labelled rows outside test, the accuracy of the most frequent class in each eighth of the values is compared
    with that of the majority class. A column that is the label itself (each value one class) or a control is skipped.
    """
    notes = []
    known = {column for columns in pack.spec.controls.values() for column in columns}
    for task in pack.spec.tasks:
        labels = pack.labels(task.name, "train", "val")
        rows, labels = np.flatnonzero(labels >= 0), labels[labels >= 0]
        if len(rows) < 64:
            continue
        for name, values in numeric_columns(pack):
            if name in known:
                continue
            mine = values[rows]
            if not np.isfinite(mine).all() or len(np.unique(mine)) < 2 or _is_label(mine, labels):
                continue
            part = np.searchsorted(np.unique(np.quantile(mine, np.arange(1, 8) / 8)), mine)
            notes += _predicts(name, task.name, part, labels)
    advice = "report them with every score as a control (--data.controls name=column)" if notes else ""
    evidence = "; ".join(notes) or "no column of numbers does"
    return Finding("columns that give a label away", "look" if notes else "ok", evidence, advice)


def _is_label(values: np.ndarray, labels: np.ndarray) -> bool:
    """Return whether the values are few and each has one label only: the label itself, or another name for it."""
    names, numbers = np.unique(values, return_inverse=True)
    one_class = (len(set(labels[numbers == i])) == 1 for i in range(len(names)))
    return len(names) <= 2 * len(np.unique(labels)) and all(one_class)


def numeric_columns(pack: Pack) -> Iterator[tuple[str, np.ndarray]]:
    """Yield (name, float [N]) of columns of numbers (or text of numbers), except ids, groups, labels and checksums."""
    other = {"id", *(task.name for task in pack.spec.tasks)}
    names = [pack.column(key).astype(str) for key in ("group", "touch_group") if key in pack.table.column_names]
    for name in pack.table.column_names:
        values = pack.column(name)
        if name in other or name.startswith(("label_", "crc_", "bytes_")):
            continue
        if any((values.astype(str) == one).all() for one in names):
            continue
        values = _parsed(values) if values.dtype.kind == "O" else values
        if values is not None and values.dtype.kind in "fiub":
            yield name, values.astype(float)


def _parsed(values: np.ndarray) -> np.ndarray | None:
    """Convert a text column to float, gaps to NaN; None unless at least 90 % of the cells are numbers."""
    out = np.full(len(values), np.nan)
    known = 0
    for i, cell in enumerate(values):
        try:
            out[i] = float("" if "_" in str(cell) else cell)  # 20220319_002026 is a name
            known += 1
        except (TypeError, ValueError):
            continue
    return out if known >= 0.9 * len(values) else None


def published(counts: list[Count]) -> list[Finding]:
    """Compare counts of the source with the published ones."""
    findings = []
    for count in counts:
        same = count.published == count.found
        detail = f"; {count.detail}" if count.detail else ""
        evidence = f"{count.found} found, {count.published} published{detail}"
        advice = "" if same else "fine for a part of the data; mention it with every result"
        findings.append(Finding(f"published: {count.what}", "ok" if same else "look", evidence, advice))
    return findings
