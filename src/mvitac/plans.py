"""Plans: which methods, settings and seeds to compare, as data. The paper's tables and ablations are three of them.

A plan of your own is a TOML or JSON file with the fields of ``Plan`` (``mvitac compare --help`` shows one).
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from mvitac.controls import CONTROLS
from mvitac.datasets.base import DatasetConfig
from mvitac.probe import Probe
from mvitac.recipes import recipe, with_method
from mvitac.record import brief
from mvitac.registry import from_json, to_json, unknown
from mvitac.run import Run

Printed = dict[str, dict[str, float]]
"""modality -> task -> top-1 % as printed in the paper."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """One line of the comparison: a method with its settings, run once per seed."""

    label: str
    """Its name in the table."""
    method: str = "mvitac"
    """A registered method."""
    recipe: str | None = None
    """If given, another recipe than the plan's."""
    set: dict[str, Any] = field(default_factory=dict)
    """Fields of the run to change, by dotted name, e.g. {"method.temperature": 0.2, "optim.lr": 0.03}."""
    printed: Printed = field(default_factory=dict)
    """The paper's numbers for this row."""


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What is compared with what."""

    name: str
    """Names the folder of its runs."""
    rows: tuple[Row, ...]
    """The lines of the table, in order."""
    title: str = ""
    """Heading of the table."""
    reference: str = "MViTac"
    """Label of the row that every other one is tested against."""
    recipe: str = "demo"
    """The recipe of every row that names none; the same budget for all."""
    seeds: int = 3
    """Seeds 0 .. seeds - 1."""
    set: dict[str, Any] = field(default_factory=dict)
    """Fields to change in every row; a row's own come after them."""
    data: DatasetConfig | None = None
    """The dataset, with its name; --data overrules it."""
    folds: tuple[str, ...] = ()
    """Cross-validation: fields of the data that make each fold, e.g. ("split=fold1", "split=fold2"); every row runs on all
    folds, and their test groups, which must differ, are pooled."""
    probes: tuple[Probe, ...] = ("linear",)
    """How features are scored; the table shows the first."""
    tasks: tuple[str, ...] = ()
    """Tasks to score; none given = all of the data's."""
    modalities: tuple[Literal["touch", "vision", "both"], ...] = ()
    """Modalities to score; none given = all."""
    stress: bool = False
    """Also score few labels, noisy test images, a modality missing at test time, a leaking split (``mvitac.stress``)."""
    printed_on: str = ""
    """Name of the dataset that the paper's numbers are about."""
    printed_majority: dict[str, float] = field(default_factory=dict)
    """task -> majority rate as printed."""

    def __post_init__(self) -> None:
        if not self.rows:
            raise ValueError(f"plan {self.name!r} has no rows: give at least one")
        if not 1 <= self.seeds <= 1000:
            raise ValueError(f"seeds {self.seeds}: give 1 to 1000")
        labels = [row.label for row in self.rows]
        for label in labels:
            if label in CONTROLS:
                raise ValueError(f"row {label!r} has the name of a control: give it another label")
            if labels.count(label) > 1:
                raise ValueError(f"row {label!r} is there twice: give each row its own label")
        if len({slug(label) for label in labels}) < len(labels):
            raise ValueError(f"plan {self.name!r}: labels differ only in signs that a folder's name cannot hold")
        for fold in self.folds:
            if self.folds.count(fold) > 1:
                raise ValueError(f"fold {fold!r} is there twice: its test groups would count twice")
            for pair in fold.split(","):
                setting(pair, "fold")
        if self.reference not in labels:
            raise unknown("reference row", self.reference, labels)

    def only(self, labels: Sequence[str]) -> Plan:
        """The plan with the rows of these labels and the reference; all rows if none is given."""
        known = [row.label for row in self.rows]
        for label in labels:
            if label not in known:
                raise unknown("row", label, known)
        wanted = {*labels, self.reference} if labels else set(known)
        return replace(self, rows=tuple(row for row in self.rows if row.label in wanted))

    def in_folds(self) -> list[tuple[str, Plan]]:
        """A plan for each fold, with its name; the plan itself, without a name, where there are none."""
        if not self.folds:
            return [("", self)]
        assert self.data is not None
        whole = recipe(self.recipe, self.data)  # not a row's run: what a row alone changes in its data stays its own
        parts = [
            {f"data.{k}": v for k, v in (setting(pair, "fold") for pair in fold.split(","))} for fold in self.folds
        ]
        names = [slug(" ".join(str(value) for value in part.values())) for part in parts]
        if len(set(names)) < len(names):
            names = [slug(fold) for fold in self.folds]
        if "" in names or len(set(names)) < len(names):
            raise ValueError(
                f"folds {', '.join(self.folds)}: each needs a folder of its own, but letters and digits do not tell them"
                " apart: give them other names"
            )
        datas = [changed(whole, part).data for part in parts]
        return [(name, replace(self, data=data, folds=())) for name, data in zip(names, datas, strict=True)]

    def run(self, row: Row, data: DatasetConfig, seed: int) -> Run:
        """The whole run of one row and seed; ValueError names a field that does not exist or fit."""
        try:
            base = with_method(recipe(row.recipe or self.recipe, data), row.method)
            return replace(changed(base, {**self.set, **row.set}), seed=seed)
        except ValueError as error:
            raise ValueError(f"row {row.label!r}: {error}") from None


def slug(label: str) -> str:
    """A label as the name of a folder."""
    return "-".join("".join(c if c.isalnum() or c in ".=" else " " for c in label.lower()).split())


def changed(run: Run, changes: Mapping[str, Any]) -> Run:
    """``run`` with fields changed by dotted name, values as in JSON."""
    value = to_json(run)
    for name, new in changes.items():
        *path, last = name.split(".")
        inner = value
        for part in path:
            inner = inner.get(part) if isinstance(inner, dict) else None
        if (
            not isinstance(inner, dict)
            or last not in inner
            or (last == "name" and path and path[-1] in ("method", "data"))
        ):
            known = [key for key in inner if key != "name"] if isinstance(inner, dict) else list(value)
            raise unknown("field of a run", name, [".".join((*path, key)) for key in known] if inner else known)
        inner[last] = list(new) if isinstance(new, tuple) else new
    return Run.load(value)


def setting(text: str, what: str = "--set") -> tuple[str, Any]:
    """``field=value`` as a pair; the value is JSON where it can be, else text."""
    name, equals, value = text.partition("=")
    if not equals or not name:
        example = "split=fold1" if what == "fold" else "steps=100 or method.temperature=0.2"
        raise ValueError(f"{what} {text}: give field=value, e.g. {example}")
    try:
        return name, json.loads(value)
    except ValueError:
        return name, value


def find_plan(given: str) -> Plan:
    """A plan by name, or from a .toml or .json file; ValueError names the choices or what is wrong with the file."""
    if given in PLANS:
        return PLANS[given]
    path = Path(given)
    if path.suffix not in (".toml", ".json"):
        raise unknown("plan", given, [*PLANS, "a .toml file", "a .json file"])
    try:
        text = path.read_text()
        value = tomllib.loads(text) if path.suffix == ".toml" else json.loads(text)
    except FileNotFoundError:
        raise ValueError(f"plan {given} does not exist: choose {', '.join(PLANS)}, or give a file that does") from None
    except (ValueError, RecursionError) as error:
        raise ValueError(f"plan {given} is not valid {path.suffix[1:].upper()}: {brief(error)}") from None
    if not isinstance(value, dict):
        raise ValueError(f"plan {given}: expected an object with name and rows")
    return from_json(Plan, {"name": path.stem, **value}, "plan")


# The paper's own way, whatever the recipe, and step by step recipe `modern`'s, so that all stand in a table of one budget.
MOMENTUM = {"method.keys": "momentum", "method.pairs": "crossed"}
END_TO_END = {"method.keys": "end-to-end", "method.pairs": "crossed"}
ALL_PAIRS = {"method.keys": "end-to-end", "method.pairs": "all"}
MODERN = Row(label="MViTac, end-to-end, all pairs, no touch flips", set={**ALL_PAIRS, "augment.touch.flip": 0.0})
PRINTED = Row(label="MViTac, positives of the same image", set={**MOMENTUM, "positives": "same-image"})
"""The paper's own positives, under recipes that have others (``Run.positives``)."""

ANCESTORS = (
    Row(label="SimCLR per modality", method="simclr"),
    Row(label="MoCo per modality", method="moco"),
    Row(label="BYOL per modality", method="byol"),
    Row(label="DINO per modality", method="dino"),
    Row(label="VICReg per modality", method="vicreg"),
    Row(label="MCT", method="mct"),
)
"""The methods that the paper's own stand on."""


def _three(category: float, soft: float, rough: float) -> dict[str, float]:
    return {"category": category, "soft": soft, "rough": rough}


TABLE1 = Plan(
    name="table1",
    title="Table I: material properties by linear probes of frozen features",
    printed_on="touch-and-go",
    printed_majority=_three(18.6, 66.1, 56.3),
    rows=(
        Row(
            label="supervised, touch only",
            method="supervised",
            set={"method.modalities": ["touch"]},
            printed={"touch": _three(57.4, 89.1, 79.3)},
        ),
        Row(label="supervised, vision only", method="supervised", set={"method.modalities": ["vision"]}),
        Row(label="supervised, both", method="supervised", printed={"both": _three(48.0, 85.9, 80.0)}),
        Row(
            label="TAG (CMC)",
            method="cmc",
            printed={"touch": _three(54.7, 77.3, 79.4), "both": _three(68.6, 87.1, 82.4)},
        ),
        Row(label="TAG (CMC), its own tau .07", method="cmc", set={"method.temperature": 0.07}),
        Row(
            label="SSVTP",
            method="ssvtp",
            printed={"touch": _three(46.1, 79.7, 75.8), "both": _three(70.7, 88.6, 83.6)},
        ),
        Row(
            label="MViTac",
            set=MOMENTUM,
            printed={"touch": _three(57.6, 86.2, 82.1), "both": _three(74.9, 91.8, 84.1)},
        ),
        PRINTED,
        Row(label="MViTac, end-to-end", set=END_TO_END),
        Row(label="MViTac, end-to-end, all pairs", set=ALL_PAIRS),
        MODERN,
        *ANCESTORS,
    ),
)
"""Table I of the paper, and the methods its own stand on."""

TABLE2 = Plan(
    name="table2",
    title="Table II: grasp success on unseen objects",
    printed_on="calandra",
    set={"augment.vision.grayscale": 0.0, "augment.touch.grayscale": 0.0},  # appendix B: none for grasping
    rows=(
        Row(label="TAG (CMC)", method="cmc", printed={"both": {"success": 56.3}}),
        Row(label="TAG (CMC), its own tau .07", method="cmc", set={"method.temperature": 0.07}),
        Row(label="SSVTP", method="ssvtp"),
        Row(label="MViTac", set=MOMENTUM, printed={"both": {"success": 60.3}}),
        PRINTED,
        Row(label="MViTac, end-to-end", set=END_TO_END),
        Row(label="MViTac, end-to-end, all pairs", set=ALL_PAIRS),
        MODERN,
        Row(label="Calandra et al., supervised", method="calandra", printed={"both": {"success": 73.1}}),
        Row(label="supervised, touch only", method="supervised", set={"method.modalities": ["touch"]}),
        Row(label="supervised, vision only", method="supervised", set={"method.modalities": ["vision"]}),
        Row(label="supervised, both", method="supervised"),
        *ANCESTORS,
    ),
)
"""Table II of the paper, and the methods its own stand on."""


def _losses(*names: str) -> Row:
    return Row(label=f"losses {' + '.join(names)}", set={"method.losses": list(names)})


def _touch_and_vision(name: str, value: Any) -> dict[str, Any]:
    return {f"augment.{modality}.{name}": value for modality in ("touch", "vision")}


ABLATION = Plan(
    name="ablation",
    title="One change at a time",
    set=MOMENTUM,
    rows=(
        Row(label="MViTac"),
        *(Row(label=f"temperature {tau}", set={"method.temperature": tau}) for tau in (0.07, 0.2, 0.5, 1.0)),
        *(Row(label=f"lambda_inter {w}", set={"method.lambda_inter": w}) for w in (0.25, 0.5, 2.0, 4.0)),
        *(_losses(name) for name in ("vv", "tt", "vt", "tv")),
        _losses("vv", "tt"),
        _losses("vt", "tv"),
        _losses("vv", "vt"),
        _losses("tt", "tv"),
        _losses("vv", "tv"),
        _losses("tt", "vt"),
        *(
            Row(label=f"momentum {m}", set={"method.momentum": m, "method.momentum_end": None})
            for m in (0.0, 0.5, 0.9, 0.99, 0.999)
        ),
        Row(label="keys end-to-end", set=END_TO_END),
        Row(label="keys end-to-end, all pairs of views", set=ALL_PAIRS),
        Row(label="symmetric", set={"method.symmetric": True}),
        Row(label="keys by running BatchNorm statistics", set={"method.key_norm": "running"}),
        Row(label="shared heads", set={"method.shared_heads": True}),
        Row(label="heads without BatchNorm", set={"method.head_norm": False}),
        Row(label="heads with BatchNorm", set={"method.head_norm": True}),
        Row(
            label="Adam lr .03 as printed",
            set={"optim.name": "adam", "optim.lr": 0.03, "optim.schedule": "constant", "optim.warmup": 0.0}
            | {"optim.eps": 1e-7, "optim.weight_decay": 0.0},
        ),
        Row(label="grayscale .2", set=_touch_and_vision("grayscale", 0.2)),
        Row(label="no grayscale", set=_touch_and_vision("grayscale", 0.0)),
        Row(label="no flips", set=_touch_and_vision("flip", 0.0)),
        Row(label="no touch flips", set={"augment.touch.flip": 0.0}),
        Row(label="plain touch flips", set={"augment.gel_flip": "plain", "augment.touch.flip": 0.5}),
        Row(label="touch flips with their colours", set={"augment.gel_flip": "colour", "augment.touch.flip": 0.5}),
        Row(label="difference images of touch", set={"data.difference": True}),
        Row(label="shuffled batches", set={"sampler": "shuffle"}),
        Row(label="one row per touch in a batch", set={"sampler": "one-per-touch"}),
        Row(label="positives of the same image", set={"positives": "same-image"}),
        Row(label="positives of the same touch", set={"positives": "same-touch"}),
        Row(label="networks in fp32", set={"precision": "fp32"}),
        Row(label="networks in bf16", set={"precision": "bf16"}),
    ),
)
"""The paper's design, one choice at a time. A row that changes nothing under the chosen recipe is left out of a run."""

RECIPES_PLAN = Plan(
    name="recipes",
    title="MViTac under each recipe",
    reference="MViTac, modern",
    recipe="modern",
    rows=tuple(Row(label=f"MViTac, {name}", recipe=name) for name in ("paper", "authors", "modern")),
)
"""The recipes as they are, each with its own budget: make it equal with --set steps=N."""

PLANS = {plan.name: plan for plan in (TABLE1, TABLE2, ABLATION, RECIPES_PLAN)}
