"""The plans that ship: the paper's Tables I and II, the ablation, the recipes."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any

from mvitac.experiments.plan import Plan, Row
from mvitac.registry import from_json, unknown
from mvitac.system.files import brief


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
