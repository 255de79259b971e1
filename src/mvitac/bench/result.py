"""The result of a bench: one JSON file per encoder with everything to check it.

    format, suite (definition), suite_digest
    encoder   name, weights (digests), parameters, images_seen, licence, trained_on, ...
    versions  of mvitac, torch and what decodes images
    blocks    for each task: data digests, groups, leaks, and of each probe, of the encoder and of the controls, sums per
              test group. It holds no score: all are computed from these sums when it is read (``records_of``)
    digest    sha256 of all of this as canonical JSON (sorted keys)
    about     time, seconds, machine, commit: not in the digest, as they differ when the same is measured again

The digest shows that a file was changed by accident or by hand, not who made it: scores are believed when repeated.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

from mvitac.bench.suite import Suite, find_suite, outdated, pinned, shipped
from mvitac.evaluation.value_scores import SUMS, r_squared
from mvitac.registry import from_json
from mvitac.system.files import digest, read_json, write_atomic

FORMAT, FORMAT_VERSION = FORM = "mvitac-bench", 2
VOLATILE = ("digest", "about")  # fields that the digest leaves out
KEY = ("source", "seed", "modality", "probe")
COUNTS = ("n", "correct")  # sums per group of classes: rows, and those that are right


def stored(record: dict[str, Any]) -> dict[str, Any]:
    """What a result keeps of a probe's record: sums per test group, of values in ten digits."""
    about = {name: record[name] for name in (*KEY, "clipped") if name in record}
    if "group_sums" not in record:
        return {**about, "sums": {"n": record["group_sizes"], "correct": record["group_correct"]}}
    sums = {name: [[float(f"{x:.10g}") for x in each] for each in record["group_sums"][name]] for name in SUMS}
    return {**about, "targets": [[target["name"], target["unit"]] for target in record["targets"]], "sums": sums}


def records_of(block: dict[str, Any], encoder: dict[str, Any]) -> list[dict[str, Any]]:
    """The records of a block as ``evaluation.scores`` takes them; those of the encoder get its name and leaks."""
    found = []
    for one in block["records"]:
        record = {"task": block["task"], **one, **_scores(one)}
        if not one["source"]:
            record |= {"source": encoder["name"], "leak": block["leaks"][encoder["seeds"].index(one["seed"])]}
        found.append(record)
    return found


def _scores(record: dict[str, Any]) -> dict[str, Any]:
    sums = record["sums"]
    if "targets" not in record:
        accuracy = sum(sums["correct"]) / sum(sums["n"])
        return {"group_sizes": sums["n"], "group_correct": sums["correct"], "accuracy": accuracy}
    total = {name: np.array(sums[name], float).sum(1) for name in SUMS}
    r2, mae = r_squared(total), total["error"] / total["n"]
    rmse = (total["squared_error"] / total["n"]) ** 0.5
    targets = [
        {"name": name, "unit": unit, "r2": float(r2[t]), "mae": float(mae[t]), "rmse": float(rmse[t])}
        for t, (name, unit) in enumerate(record["targets"])
    ]
    return {"group_sums": sums, "targets": targets, "r2": float(r2.mean())}


def sign(
    form: tuple[str, int], suite: Any, encoder: dict[str, Any], found: dict[str, Any], here: dict[str, Any]
) -> dict[str, Any]:
    """The whole result with its digest. ``found`` is what was measured, ``here`` ``provenance``, with the time."""
    value = {"format": form[0], "format_version": form[1], "suite": suite.definition(), "suite_digest": suite.digest()}
    value |= {"encoder": encoder, "versions": here.pop("versions"), **found}
    return {**value, "digest": digest(value), "about": here}


def write_result(path: Path, value: dict[str, Any]) -> None:
    """Write a result, one line for each of its fields."""
    lines = (f"{json.dumps(k)}: {json.dumps(v, separators=(',', ':'), allow_nan=False)}" for k, v in value.items())
    write_atomic(path, lambda file: file.write(("{\n" + ",\n".join(lines) + "\n}\n").encode()))


def read_signed(path: Path, form: tuple[str, int] = FORM) -> dict[str, Any]:
    """Read a result of this format; ValueError if it is none, is damaged, or was changed since it was written."""
    value = read_json(path, "a result of the bench")
    if not isinstance(value, dict) or value.get("format") != form[0]:
        raise ValueError(f"{path} is not a result of the bench: give a file that `mvitac bench MODEL` wrote")
    if value.get("format_version") != form[1]:
        raise ValueError(f"{path} has format {value.get('format_version')}, this version reads {form[1]}")
    if value.get("digest") != digest({key: part for key, part in value.items() if key not in VOLATILE}):
        raise ValueError(f"{path} does not match its digest: it was changed after it was written, run the bench again")
    return value


def read_result(path: Path) -> dict[str, Any]:
    """Read a result of a suite of tasks; ValueError also if its suite is not that of this version."""
    value = read_signed(path)
    try:
        suite = suite_of(value)
    except (KeyError, ValueError) as error:
        raise ValueError(f"{path} is damaged ({error}): run the bench again") from None
    if value.get("suite_digest") != suite.digest():
        raise ValueError(f"{path}: the suite inside does not have the digest that the file says: run the bench again")
    if now := outdated(suite):
        raise ValueError(f"{path} is of another {suite.name} than {now} of this version: run the bench again")
    return value


def suite_of(value: dict[str, Any]) -> Suite:
    """The definition inside a result. One of this version has its pins; no file can bring its own."""
    suite = from_json(Suite, value["suite"], "suite")
    return find_suite(suite.name) if suite.name in shipped() and not outdated(suite) else suite


def pinned_of(suite: Suite, block: dict[str, Any]) -> str:
    """Whether the data of a block is what the suite was measured on (``suite.Pinned``)."""
    (one,) = (one for one in suite.sets if one.name == block["set"])
    return pinned({form.name: form for form in one.forms}[block["form"]], block["data"])
