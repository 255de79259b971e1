"""The result of a bench: one JSON file per encoder with everything to check it.

    format, suite (definition), suite_digest
    encoder   name, weights (digests), parameters, images_seen, licence, trained_on, ...
    versions  of mvitac, torch and what decodes images
    blocks    for each task: data digests, groups, leaks, scores of the encoder and of the controls per test group
    digest    sha256 of all of this as canonical JSON (sorted keys)
    about     time, seconds, machine, commit: not in the digest, as they differ when the same is measured again

The digest shows that a file was changed by accident or by hand. It does not show who made it: scores are believed when
someone repeats them.
"""

import json
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mvitac.bench.suite import Suite, find_suite, shipped
from mvitac.evaluation.value_scores import SUMS, r_squared
from mvitac.registry import from_json, to_json
from mvitac.system.files import digest, read_json, write_atomic

FORMAT, FORMAT_VERSION = "mvitac-bench", 1
VOLATILE = ("digest", "about")  # fields that the digest leaves out
KEPT = (
    *("source", "seed", "task", "modality", "probe", "accuracy", "balanced_accuracy", "macro_f1", "auroc", "num_test"),
    *("group_sizes", "group_correct", "r2", "targets", "group_sums", "C", "alpha", "clipped", "steps"),
)
"""Fields of a record of a probe that a result keeps."""
VERSION = re.compile(r"-v\d+$")  # at the end of a suite's name
SHARED = ("n", "value", "squared_value")
"""Sums per group that depend on the rows alone: they are written once for all records of a task."""


def trimmed(record: dict[str, Any]) -> dict[str, Any]:
    """The fields of a probe's record that a result keeps, with sums in ten digits."""
    kept = {name: record[name] for name in KEPT if name in record}
    if "targets" in kept:
        fields = ("name", "unit", "r2", "mae", "rmse")
        kept["targets"] = [{name: target[name] for name in fields} for target in kept["targets"]]
        kept["group_sums"] = {
            name: [[float(f"{x:.10g}") for x in each] for each in sums] for name, sums in kept["group_sums"].items()
        }
    return kept


def _folded(block: dict[str, Any]) -> dict[str, Any]:
    """``block`` with what its records share written once: the sizes of groups, and the sums of true values."""
    if "records" not in block:
        return block
    rows: list[dict[str, Any]] = []
    records = []
    for record in block["records"]:
        sums = record.get("group_sums")
        same = {name: sums[name] for name in SHARED} if sums else {"group_sizes": record["group_sizes"]}
        own = {"group_sums": {name: sums[name] for name in SUMS if name not in SHARED}} if sums else {}
        if same not in rows:
            rows.append(same)
        records.append({**{k: v for k, v in record.items() if k != "group_sizes"}, **own, "rows": rows.index(same)})
    return {**block, "rows": rows, "records": records}


def records_of(block: dict[str, Any], encoder: dict[str, Any]) -> list[dict[str, Any]]:
    """The records of a block as ``evaluation.scores`` takes them; those of the encoder get its name and leaks."""
    found = []
    for record in block["records"]:
        same = block["rows"][record["rows"]]
        whole = {key: value for key, value in record.items() if key != "rows"}
        if "group_sums" in record:
            whole["group_sums"] = {**same, **record["group_sums"]}
        else:
            whole["group_sizes"] = same["group_sizes"]
        if not record["source"]:
            leak = block["leaks"][encoder["seeds"].index(record["seed"])]
            whole |= {"source": encoder["name"], "leak": leak}
        found.append(whole)
    return found


def sign(
    suite: Suite, encoder: dict[str, Any], blocks: Sequence[dict[str, Any]], here: dict[str, Any]
) -> dict[str, Any]:
    """The whole result with its digest. ``here`` is ``provenance``, with the time."""
    versions = here.pop("versions")
    value = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "suite": to_json(suite),
        "suite_digest": suite.digest(),
        "encoder": encoder,
        "versions": versions,
        "blocks": [_folded(block) for block in blocks],
    }
    return {**value, "digest": digest(value), "about": here}


def write_result(path: Path, value: dict[str, Any]) -> None:
    """Write a result, one line for each of its fields."""
    lines = (f"{json.dumps(k)}: {json.dumps(v, separators=(',', ':'), allow_nan=False)}" for k, v in value.items())
    text = "{\n" + ",\n".join(lines) + "\n}\n"
    write_atomic(path, lambda file: file.write(text.encode()))


def read_result(path: Path) -> dict[str, Any]:
    """Read a result; ValueError if it is none, is damaged, or was changed since it was written."""
    value = read_json(path, "a result of the bench")
    if not isinstance(value, dict) or value.get("format") != FORMAT:
        raise ValueError(f"{path} is not a result of the bench: give a file that `mvitac bench MODEL` wrote")
    if value.get("format_version") != FORMAT_VERSION:
        raise ValueError(f"{path} has format {value.get('format_version')}, this version reads {FORMAT_VERSION}")
    given = digest({key: part for key, part in value.items() if key not in VOLATILE})
    if value.get("digest") != given:
        raise ValueError(f"{path} does not match its digest: it was changed after it was written, run the bench again")
    try:
        suite = suite_of(value)
    except (KeyError, ValueError) as error:
        raise ValueError(f"{path} has no valid suite ({error}): run the bench again") from None
    if value.get("suite_digest") != suite.digest():
        raise ValueError(f"{path}: the suite inside does not have the digest that the file says: run the bench again")
    if suite.name in shipped() and find_suite(suite.name).digest() != suite.digest():
        raise ValueError(
            f"{path} is of another version of {suite.name} ({suite.digest()[:12]}, this version has"
            f" {find_suite(suite.name).digest()[:12]}): run the bench again"
        )
    now = {VERSION.sub("", name): name for name in shipped()}.get(VERSION.sub("", suite.name), suite.name)
    if now != suite.name:
        raise ValueError(f"{path} is of {suite.name}, this version has {now}: run the bench again")
    return value


def suite_of(value: dict[str, Any]) -> Suite:
    """The definition inside a result."""
    return from_json(Suite, value["suite"], "suite")


def problems(value: dict[str, Any]) -> list[str]:
    """What does not follow from the result's own numbers, in one line each: scores, groups, controls, missing tasks."""
    found, suite = [], suite_of(value)
    asked = [(one.name, ask.name) for one in suite.sets for ask in one.tasks]
    if asked != (have := [(block["set"], block["task"]) for block in value["blocks"]]):
        found.append(f"has the tasks {have}, the suite asks for {asked}")
    for block in value["blocks"]:
        where = f"{block['set']}, {block['task']}"
        if "not_run" in block:
            continue
        if len(block["leaks"]) != len(value["encoder"]["seeds"]):
            found.append(f"{where}: has {len(block['leaks'])} leak marks for {len(value['encoder']['seeds'])} seeds")
        records = records_of(block, value["encoder"])
        if block["records"] and value["encoder"]["name"] in {r["source"] for r in block["records"]}:
            found.append(f"{where}: the encoder has the name of a control, {value['encoder']['name']!r}: give --name")
        if lacking := {"untrained", "pixels"} - {r["source"] for r in records}:
            found.append(f"{where}: lacks the controls {', '.join(sorted(lacking))}")
        for record in records:
            what = f"{where}, {record['modality']}, {record['source']}, {record['probe']}"
            found += [f"{what}: {text}" for text in _wrong(record, len(block["groups"]))]
    return found


def _wrong(record: dict[str, Any], num_groups: int) -> list[str]:
    """What is wrong with the scores of one record."""
    if "group_sums" not in record:
        sizes, correct = np.array(record["group_sizes"]), np.array(record["group_correct"])
        if len(sizes) != len(correct) or len(sizes) > num_groups:
            return [f"has {len(correct)} counts of {len(sizes)} groups, the task has {num_groups} groups"]
        if (correct < 0).any() or (correct > sizes).any() or sizes.sum() != record["num_test"]:
            return ["more correct rows than rows"]
        return _differs("accuracy", record["accuracy"], correct.sum() / sizes.sum())
    sums = {name: np.array(record["group_sums"][name], float) for name in SUMS}
    shape = (len(record["targets"]), len(sums["n"][0]))
    if any(each.shape != shape for each in sums.values()) or shape[1] > num_groups:
        return [f"its sums are not of {shape[0]} targets and {num_groups} groups"]
    total = {name: each.sum(1) for name, each in sums.items()}
    wrong = _differs("r2", record["r2"], float(r_squared(total).mean()))
    for t, target in enumerate(record["targets"]):
        wrong += _differs(f"mae of {target['name']}", target["mae"], total["error"][t] / total["n"][t])
        wrong += _differs(
            f"rmse of {target['name']}", target["rmse"], (total["squared_error"][t] / total["n"][t]) ** 0.5
        )
    return wrong


def _differs(what: str, given: float, found: float) -> list[str]:
    same = math.isclose(given, found, rel_tol=1e-5, abs_tol=1e-6)
    return [] if same else [f"{what} is {given:.6g}, its sums per group give {found:.6g}"]
