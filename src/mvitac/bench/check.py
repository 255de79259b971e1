"""What a result of the bench cannot be: missing tasks, records and fields, and sums that no predictions give."""

import itertools
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from mvitac.bench.external.adapters import parse
from mvitac.bench.result import COUNTS, KEY, VOLATILE, pinned_of, suite_of
from mvitac.bench.suite import Suite, SuiteSet, SuiteTask, simulated_spec
from mvitac.data.spec import MODALITIES
from mvitac.datasets.table.columns import value_task
from mvitac.evaluation import few_labels
from mvitac.evaluation.controls import CONTROLS
from mvitac.evaluation.leaks import declared_leak
from mvitac.evaluation.probe import VALUE_PROBES
from mvitac.evaluation.value_scores import SUMS

ABOUT_ROWS = ("n", "value", "squared_value")  # sums that depend on the rows alone
FIELDS = ("format", "format_version", "suite", "suite_digest", "encoder", "versions", *VOLATILE)
ABOUT = ("python", "machine", "commit", "time", "seconds")
ENCODER = ("external", "method", "features", "licence", "trained_on", "images_seen", "size", "parameters")
ENCODER = ("name", "seeds", "weights", *ENCODER)
EXTERNAL = ("encoder", "title", "seed", "weights", "notes", "encoders")
BLOCK = ("set", "task", "not_run", "form", "data", "group_by", "groups", "leaks", "left_out", "records", "notes")
NO_IMAGENET = "without the control imagenet"  # a note
MISFIT = ("the encoder takes ", "the encoder was trained on touch ")  # reasons of runs alone (``misfit``)
WINDOWS = "the encoder takes windows"  # a reason that holds for all data
GUESS = "majority or mean"  # what the page calls these two controls
MAX_NAME = 200


def problems(value: dict[str, Any]) -> list[str]:
    """What is missing in a result, or cannot be, in one line each: tasks, scores, controls, sums, data."""
    suite, encoder = suite_of(value), value["encoder"]
    found = [*unknown_fields(value, [(value, (*FIELDS, "blocks")), *((block, BLOCK) for block in value["blocks"])])]
    found += problems_of(encoder, (*CONTROLS, GUESS))
    several: dict[tuple[str, int | None], list[Any]] = {}
    for records in (block.get("records", ()) for block in value["blocks"]):
        # Seeds may well have the same sums where they know everything, or nothing.
        told = [record["sums"] for record in records if record["modality"] == "none"]
        for sums, key in ((r["sums"], (r["source"], r["seed"])) for r in records):
            if sums not in told and sums.get("correct") != sums.get("n"):
                several.setdefault(key, []).append(sums)
    for (one, first), (other, second) in itertools.combinations(several, 2):
        if one == other and several[one, first] == several[other, second] and len(several[one, first]) > 1:
            found.append(f"{one or 'the encoder'} has the same sums in every record of seeds {first} and {second}")
    found += _seeds_alike(value["blocks"])
    asked = [(one, ask) for one in suite.sets for ask in one.tasks]
    if (want := [(s.name, t.name) for s, t in asked]) != (have := [(b["set"], b["task"]) for b in value["blocks"]]):
        return [*found, f"has the tasks {have}, the suite asks for {want}"]
    if all("not_run" in block for block in value["blocks"]):
        found.append("was run on no task")
    data: dict[str, Any] = {}
    scored: dict[str, set[str]] = {one.name: set() for one in suite.sets}
    for block, record in ((b, r) for b in value["blocks"] for r in b.get("records", ()) if not r["source"]):
        scored[block["set"]] |= _senses(record["modality"])
    anywhere: set[str] = set().union(*scored.values())
    reads = {*encoder["parameters"], *encoder.get("features", ()), *anywhere}
    here = {one.name for one in suite.sets for form in one.forms if not form.at}  # data that can be had anywhere
    here |= {block["set"] for block in value["blocks"] if "data" in block}
    for block, (one, ask) in zip(value["blocks"], asked, strict=True):
        held = block.get("data"), block.get("group_by")
        if "data" in block and data.setdefault(one.name, held) != held:
            found.append(f"{one.name}, {ask.name}: its data or groups are not those of the set's other tasks")
        given: list[tuple[Sequence[str], str]] = [((m,), why) for m, why in block.get("left_out", {}).items()]
        if "not_run" in block and (one.name in here or block["not_run"].startswith("the encoder ")):
            given.append((ask.modalities, block["not_run"]))
        beside = {why: anywhere if why.startswith(WINDOWS) else scored[one.name] for _, why in given}
        untrue = [each for each in given if _untrue(*each, encoder, reads, beside[each[1]])]
        found += [f"{one.name}, {ask.name}: {' and '.join(m)} cannot be left out because {why}" for m, why in untrue]
        if "not_run" not in block:
            found += [f"{one.name}, {ask.name}: {text}" for text in _of_block(block, suite, one, ask, encoder)]
    return found


def _seeds_alike(blocks: Sequence[dict[str, Any]]) -> list[str]:
    """Seeds with the same values in a task (by ridge, which no two features give) that differ in another."""
    alike: dict[Any, set[bool]] = {}
    for records in (block.get("records", ()) for block in blocks):
        none = [record["sums"] for record in records if record["modality"] == "none"]
        own = [record for record in records if not record["source"] and record["sums"] not in none]
        for one, other in itertools.combinations(own, 2):
            equal, sure = one["sums"] == other["sums"], "targets" in one and one["probe"] != "knn"
            if one["modality"] == other["modality"] and one["probe"] == other["probe"] and (sure or not equal):
                alike.setdefault((one["modality"], one["seed"], other["seed"]), set()).add(equal)
    same = "have the same values in some tasks"
    return [f"the encoder by {m}: seeds {a} and {b} {same}" for (m, a, b), both in alike.items() if len(both) > 1]


def _senses(modality: str) -> set[str]:
    return {*MODALITIES} if modality == "both" else {modality}


def _untrue(modalities: Sequence[str], why: str, encoder: dict[str, Any], reads: set[str], scored: set[str]) -> bool:
    """Whether ``why`` is no reason for scores that are not there: ``reads`` the encoder somewhere, ``scored`` in the set."""
    senses, run = [_senses(m) for m in modalities], "external" not in encoder
    known = why in {f"the encoder has no {m}" for m in set().union(*senses) - reads} or (run and why.startswith(MISFIT))
    return not known or any(each <= (scored if run else reads) for each in senses)


def unknown_fields(value: dict[str, Any], parts: Sequence[tuple[dict[str, Any], Sequence[str]]]) -> Iterator[str]:
    """Fields of ``parts``, and of what all results have, that nobody reads."""
    encoder, versions = value["encoder"], value["versions"]
    texts = [*versions.values()] if isinstance(versions, dict) else [None]
    if not all(isinstance(text, str) for text in texts) or not {"mvitac", "torch"} <= versions.keys():
        yield "its versions are no texts, or lack mvitac or torch"
    shared = (value.get("about", {}), ABOUT), (encoder, ENCODER), (encoder.get("external", {}), EXTERNAL)
    for fields, known in (*shared, *parts):
        yield from (f"has the unknown field {name!r}" for name in sorted(fields.keys() - {*known}))


def are_digests(texts: Sequence[Any]) -> bool:
    return all(re.fullmatch("[0-9a-f]{64}", str(text)) for text in texts)


def wrong_name(name: str, controls: Sequence[str]) -> str:
    """What an encoder cannot be called; "" if it can."""
    if name.strip().casefold() in controls:
        return f"has the name of a control, {name!r}"
    good = name == name.strip() != "" and name.isprintable() and len(name) <= MAX_NAME
    return "" if good else f"has the name {name[:MAX_NAME]!r}"


def problems_of(encoder: dict[str, Any], controls: Sequence[str]) -> Iterator[str]:
    """What a result cannot say of its encoder."""
    if why := wrong_name(encoder["name"], controls):
        yield f"the encoder {why}: give --name"
    seeds, weights = encoder["seeds"], encoder["weights"]
    seen = 0 if encoder["images_seen"] is None else encoder["images_seen"]
    sizes = [*encoder["parameters"].items(), *encoder.get("features", {}).items()]
    numbers = [("images_seen", seen), ("size", encoder["size"]), *sizes]
    yield from (f"{key} is {n}" for key, n in numbers if type(n) is not int or not 0 <= n < 1e18)
    texts = {key: encoder[key] for key in ("licence", "trained_on")}
    yield from (f"{key} is no text" for key, text in texts.items() if not isinstance(text, str | None))
    if not are_digests(weights):
        yield "a digest of weights is none"
    if not len(seeds) == len(set(seeds)) == len(set(weights)) == len(weights):
        yield f"has {len(set(weights))} weights for seeds {seeds}"
    if network := encoder.get("external"):
        told = [[network.get("seed")], [network.get("weights")], network.get("encoders", {}).keys()]
        if told != [seeds[:1], weights[:1], encoder["parameters"].keys()]:  # that of the first seed
            yield "its network is of other seeds, weights or senses"
    elif encoder.get("features", {}).keys() != encoder["parameters"].keys():
        yield "its features and parameters are of other senses"


def _of_block(
    block: dict[str, Any], suite: Suite, one: SuiteSet, ask: SuiteTask, encoder: dict[str, Any]
) -> Iterator[str]:
    records, forms = block["records"], [form for form in one.forms if form.name == block["form"]]
    if not forms:
        yield f"the suite has no form {block['form']!r}"
    elif pinned_of(suite, block) == "other rows" and any(form.at for form in forms):
        yield "the data has other rows, labels or splits than the suite"
    if len(block["leaks"]) != len(encoder["seeds"]):
        yield f"has {len(block['leaks'])} leak marks for {len(encoder['seeds'])} seeds"
    if "external" in encoder and {*block["leaks"]} != {declared_leak(encoder["trained_on"], one.names)}:
        yield f"its marks of leaks are not those of data trained on, {encoder['trained_on']}"
    lists = [block["leaks"], block["groups"], block.get("notes", []), [block.get("group_by")]]
    if not all(isinstance(each, list) and all(isinstance(text, str) for text in each) for each in lists):
        yield "a leak mark, a note, a group or what groups are is no text"
    if len({*block["groups"]}) < len(block["groups"]):
        yield "a group is there twice"
    if encoder["name"] in {record["source"] for record in records}:
        yield f"the encoder has the name of a control, {encoder['name']!r}: give --name"
    have = Counter((r["source"], r["modality"], r["probe"], r["seed"]) for r in records)
    want = _expected(suite, ask, block, encoder["seeds"], "targets" in records[0] if records else False)
    asked = [text for form in forms for text in form.data.get("controls", ())]
    made = [spec for form in forms if (spec := simulated_spec(form))]
    asked += [name for spec in made for name in spec.controls]
    want |= {((text.rpartition("=")[0] or text).strip(), "none", "linear", None) for text in asked}
    own = {key for key in have if key[1:] == ("none", "linear", None) and key[0] not in CONTROLS}  # columns of the data
    for what, keys in (("lacks", want - have.keys()), ("has too much of", have.keys() - want - own)):
        for source, *key in sorted(keys, key=str):
            yield f"{what} {source or 'the encoder'}, {', '.join(map(str, key))}"
    rows: dict[str, list[Any]] = {}
    for record in records:
        what = _who(record)
        if have[record["source"], record["modality"], record["probe"], record["seed"]] > 1:
            yield f"{what}: is there twice"
        if why := _impossible(record, len(block["groups"]), one.folds):
            yield f"{what}: {why}"
        scored = [record.get("targets"), *(record["sums"][name] for name in ABOUT_ROWS if name in record["sums"])]
        if rows.setdefault(record["modality"], scored) != scored:
            yield f"{what}: is scored on other rows than those above it"
    yield from _copies([record for record in records if "targets" in record])
    tasks = [value_task(text) for form in forms for text in form.data.get("values", ())]
    for task in (*tasks, *(task for spec in made for task in spec.values)):
        named, given = [[target.name, target.unit] for target in task.targets], [r.get("targets") for r in records[:1]]
        if task.name == block["task"] and given and given != [named]:
            yield f"its values are {given[0]}, those of the suite {named}"


def _who(record: dict[str, Any]) -> str:
    return f"{record['modality']}, {record['source'] or 'the encoder'}, {record['probe']}, seed {record['seed']}"


def _copies(records: Sequence[dict[str, Any]]) -> Iterator[str]:
    """Values that other features cannot give: sums have ten digits. An encoder may be a control's network."""
    mean = [record["sums"] for record in records if record["source"] == "mean"]  # all that constant features give
    for one, other in itertools.combinations([r for r in records if r["modality"] != "none"], 2):
        fixed = {one["source"], other["source"]} & {"pixels", "border"} or (one["source"] and other["source"])
        apart = one["source"] != other["source"] or (one["source"] and one["seed"] != other["seed"])
        same = one["modality"] == other["modality"] and one["sums"] == other["sums"] and one["sums"] not in mean
        if same and apart and (fixed or one.get("clipped") != other.get("clipped")):
            yield f"{_who(one)}: has the sums of {_who(other)}"
    fits: dict[Any, list[tuple[Any, bool]]] = {}  # two probes -> whether each of their fits has the same sums
    for one, other in itertools.combinations([r for r in records if r["sums"] not in mean], 2):
        if one["probe"] != other["probe"] and all(one[key] == other[key] for key in ("source", "modality", "seed")):
            fits.setdefault((one["probe"], other["probe"]), []).append((other, one["sums"] == other["sums"]))
    for (probe, _), some in fits.items():
        if any(same for _, same in some) and not all(same for _, same in some):  # they may be fitted on the same rows
            yield f"{_who(next(r for r, same in some if same))}: has the sums of {probe}"
    for record in records:
        if record["source"] in ("pixels", "untrained", "imagenet") and record["sums"] in mean:
            yield f"{_who(record)}: has the sums of mean"


Key = tuple[str, str, str, int | None]  # source ("" is the encoder), modality, probe, seed


def _expected(suite: Suite, ask: SuiteTask, block: dict[str, Any], seeds: Sequence[int], values: bool) -> set[Key]:
    few = [few_labels.name(100 * share) for share in ask.labels]
    probes = [*(kind for kind in suite.probes if not values or kind in VALUE_PROBES), *few]
    read = [m for m in ask.modalities if m not in block["left_out"]]
    found: set[Key] = {("", m, kind, seed) for m in read for kind in probes for seed in seeds}
    trunks: list[tuple[str, int | None]] = [("untrained", parse(text).seed) for text in suite.untrained]
    if NO_IMAGENET not in block.get("notes", ()):
        trunks.append(("imagenet", None))
    found |= {(name, m, kind, seed) for m in ask.modalities for kind in ("linear", *few) for name, seed in trunks}
    found |= {("pixels", m, "linear", None) for m in ask.modalities}
    found |= {("border", "touch", "linear", None)} if "touch" in ask.modalities else set()
    return found | {("mean" if values else "majority", "none", "linear", None)}


def _impossible(record: dict[str, Any], num_groups: int, folds: int) -> str:
    """Why no predictions give the sums of a record; "" if some do."""
    names = SUMS if "targets" in record else COUNTS
    if {*record["sums"]} != {*names} or {*record} - {*KEY, "clipped", "targets", "sums"}:
        return f"its fields are {sorted(record)}, its sums {sorted(record['sums'])}"
    clipped = record.get("clipped", [0, 0])  # of how many features
    if [*map(type, clipped)] != [int, int] or not 0 <= clipped[0] <= clipped[1] < 1e9:
        return f"it says that {clipped} features were clipped"
    try:
        sums = {name: np.atleast_2d(np.array(record["sums"][name], float)) for name in names}
        kinds = {np.array(values).dtype.kind for values in record["sums"].values()}
        truths = any(isinstance(x, bool) for part in record["sums"].values() for x in np.array(part, object).flat)
    except (TypeError, ValueError):
        return "its sums are no numbers"
    if truths or kinds - {"i", *"f" * ("targets" in record)}:
        return "its sums are no numbers"
    n = sums["n"]
    if any(each.shape != n.shape for each in sums.values()) or n.shape[1] > num_groups:
        return f"its sums are not of {num_groups} groups"
    texts = [text for target in record.get("targets", ()) for text in target]
    if len(texts) != 2 * len(record.get("targets", ())) or not all(isinstance(text, str) for text in texts):
        return f"its targets are {record['targets']}, not names and units"
    if "targets" in record and len(record["targets"]) != len(n):
        return f"it has sums of {len(n)} targets, and names of {len(record['targets'])}"
    whole = n if "targets" in record else np.stack([n, sums["correct"]])
    finite = all(np.isfinite(each).all() for each in sums.values())
    if not finite or (whole != whole.round()).any() or (whole < 0).any():
        return "a sum is not finite, or a number of rows is no natural number"
    if (n.sum(1) == 0).any():
        return "it has no rows"
    if "targets" not in record:
        if record["source"] == "majority" and (sums["correct"] >= n).all():
            return "one answer is right for all rows"
        return "it has more correct rows than rows" if (sums["correct"] > n).any() else ""
    least = 1 - 1e-6  # sums have ten digits
    error, squared = sums["error"], sums["squared_error"]
    if ((error < 0) | (squared < least * (error**2 / np.maximum(n, 1))) | (least * squared > error**2)).any():
        return "its squared errors are smaller or larger than its errors allow"
    square, of = sums["squared_value"] * n, sums["value"] ** 2
    wrong = (square < least * of).any() or (least * square > of)[n == 1].any()
    if record["source"] == "mean":
        answers = [_num_answers(*each) for each in zip(n, sums["value"], sums["squared_value"], squared, strict=True)]
        away = n * squared - square + of  # (n times the distance of the answer from the group's mean) squared
        if max(answers) > max(folds, 1) or ((away < -1e-6 * square) | (error**2 < away - 1e-6 * square)).any():
            return "its errors are not those of one answer" + " per fold" * bool(folds)
    return "its squares are not those of its values" if wrong else ""


def _num_answers(n: Any, value: Any, square: Any, squared: Any) -> int:
    """How many answers, each for groups next to each other, are needed to make squared errors; arrays have a group each."""
    n, value, square, squared = (each[n > 0] for each in (n, value, square, squared))
    first, found = 0, 1
    for last in range(1, len(n) + 1):
        own = slice(first, last)
        middle = value[own].sum() / n[own].sum()  # an answer is a root of the sum of its groups
        away = np.sqrt(max((squared - square)[own].sum() / n[own].sum() + middle**2, 0))
        made = np.array([square - 2 * c * value + n * c**2 for c in (middle - away, middle + away)])[:, own]
        if not (abs(made - squared[own]) <= 1e-4 * (square + n * (middle**2 + away**2))[own]).all(1).any():
            first, found = last - 1, found + 1
    return found
