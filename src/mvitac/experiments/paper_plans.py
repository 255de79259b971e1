"""Plans that ship with the package: the paper's Tables I and II, the ablation, the recipes."""

import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

from mvitac.experiments.plan import Plan, Printed, Row
from mvitac.registry import from_json, unknown
from mvitac.system.files import brief, parse_json


def find_plan(given: str) -> Plan:
    """A plan by name, or from a .toml or .json file; ValueError if it does not exist or is not valid."""
    if given in PLANS:
        return PLANS[given]
    path = Path(given)
    if path.suffix not in (".toml", ".json"):
        raise unknown("plan", given, [*PLANS, "a .toml file", "a .json file"])
    try:
        text = path.read_text()
        value = tomllib.loads(text) if path.suffix == ".toml" else parse_json(text)
    except FileNotFoundError:
        raise ValueError(f"plan {given} does not exist: choose {', '.join(PLANS)}, or give a file that does") from None
    except (ValueError, RecursionError) as error:
        raise ValueError(f"plan {given} is not valid {path.suffix[1:].upper()}: {brief(error)}") from None
    if not isinstance(value, dict):
        raise ValueError(f"plan {given}: expected an object with name and rows")
    return from_json(Plan, {"name": path.stem, **value}, "plan")


# The paper's own settings whatever the recipe, then step by step those of recipe `modern`, in a table of one budget.
MOMENTUM = {"method.keys": "momentum", "method.pairs": "crossed"}
END_TO_END = {"method.keys": "end-to-end", "method.pairs": "crossed"}
ALL_PAIRS = {"method.keys": "end-to-end", "method.pairs": "all"}
MODERN = Row(label="MViTac, end-to-end, all pairs, no touch flips", set={**ALL_PAIRS, "augment.touch.flip": 0.0})
PRINTED = Row(label="MViTac, positives of the same image", set={**MOMENTUM, "positives": "same-image"})
"""The paper's positives, for recipes with other ones (``Run.positives``)."""

ANCESTORS = (
    *(Row(label=f"{name} per modality", method=name.lower()) for name in ("SimCLR", "MoCo", "BYOL", "DINO", "VICReg")),
    Row(label="MCT", method="mct"),
)
"""Baselines that the paper's methods build on."""


def _three(category: float, soft: float, rough: float) -> dict[str, float]:
    return {"category": category, "soft": soft, "rough": rough}


def _touch_and_both(touch: tuple[float, float, float], both: tuple[float, float, float]) -> Printed:
    return {"touch": _three(*touch), "both": _three(*both)}


CMC_TAU = Row(label="TAG (CMC), its own tau .07", method="cmc", set={"method.temperature": 0.07})
TOUCH_ONLY = Row(label="supervised, touch only", method="supervised", set={"method.modalities": ["touch"]})
VISION_ONLY = Row(label="supervised, vision only", method="supervised", set={"method.modalities": ["vision"]})
MVITAC = Row(label="MViTac", set=MOMENTUM)
VARIANTS = (
    PRINTED,
    Row(label="MViTac, end-to-end", set=END_TO_END),
    Row(label="MViTac, end-to-end, all pairs", set=ALL_PAIRS),
    MODERN,
)
TABLE1 = Plan(
    name="table1",
    title="Table I: material properties by linear probes of frozen features",
    printed_on="touch-and-go (official)",
    printed_majority=_three(18.6, 66.1, 56.3),
    rows=(
        replace(TOUCH_ONLY, printed={"touch": _three(57.4, 89.1, 79.3)}),
        VISION_ONLY,
        Row(label="supervised, both", method="supervised", printed={"both": _three(48.0, 85.9, 80.0)}),
        Row(label="TAG (CMC)", method="cmc", printed=_touch_and_both((54.7, 77.3, 79.4), (68.6, 87.1, 82.4))),
        CMC_TAU,
        Row(label="SSVTP", method="ssvtp", printed=_touch_and_both((46.1, 79.7, 75.8), (70.7, 88.6, 83.6))),
        replace(MVITAC, printed=_touch_and_both((57.6, 86.2, 82.1), (74.9, 91.8, 84.1))),
        *VARIANTS,
        *ANCESTORS,
    ),
)
"""Table I of the paper, and the baselines."""

TABLE2 = Plan(
    name="table2",
    title="Table II: grasp success on unseen objects",
    printed_on="calandra (authors)",
    set={"augment.vision.grayscale": 0.0, "augment.touch.grayscale": 0.0},  # appendix B: none for grasping
    rows=(
        Row(label="TAG (CMC)", method="cmc", printed={"both": {"success": 56.3}}),
        CMC_TAU,
        Row(label="SSVTP", method="ssvtp"),
        replace(MVITAC, printed={"both": {"success": 60.3}}),
        *VARIANTS,
        Row(label="Calandra et al., supervised", method="calandra", printed={"both": {"success": 73.1}}),
        TOUCH_ONLY,
        VISION_ONLY,
        Row(label="supervised, both", method="supervised"),
        *ANCESTORS,
    ),
)
"""Table II of the paper, and the baselines."""


def _touch_and_vision(name: str, value: Any) -> dict[str, Any]:
    return {f"augment.{modality}.{name}": value for modality in ("touch", "vision")}


def _adam() -> dict[str, Any]:
    schedule = {"optim.schedule": "constant", "optim.warmup": 0.0}
    return {"optim.name": "adam", "optim.lr": 0.03, **schedule, "optim.eps": 1e-7, "optim.weight_decay": 0.0}


CHANGES: dict[str, dict[str, Any]] = {
    "MViTac": {},
    **{f"temperature {tau}": {"method.temperature": tau} for tau in (0.07, 0.2, 0.5, 1.0)},
    **{f"lambda_inter {w}": {"method.lambda_inter": w} for w in (0.25, 0.5, 2.0, 4.0)},
    **{
        f"losses {losses.replace(' ', ' + ')}": {"method.losses": losses.split()}
        for losses in ("vv", "tt", "vt", "tv", "vv tt", "vt tv", "vv vt", "tt tv", "vv tv", "tt vt")
    },
    **{f"momentum {m}": {"method.momentum": m} for m in (0.0, 0.5, 0.9, 0.99, 0.999)},
    "keys end-to-end": END_TO_END,
    "keys end-to-end, all pairs of views": ALL_PAIRS,
    "heads without BatchNorm": {"method.head_norm": False},
    "heads with BatchNorm": {"method.head_norm": True},
    "Adam lr .03 as printed": _adam(),
    "grayscale .2": _touch_and_vision("grayscale", 0.2),
    "no grayscale": _touch_and_vision("grayscale", 0.0),
    "no flips": _touch_and_vision("flip", 0.0),
    "no touch flips": {"augment.touch.flip": 0.0},
    "touch flips": {"augment.touch.flip": 0.5},
    "difference images of touch": {"data.difference": True},
    "shuffled batches": {"sampler": "shuffle"},
    "one row per touch in a batch": {"sampler": "one-per-touch"},
    "positives of the same image": {"positives": "same-image"},
    "positives of the same touch": {"positives": "same-touch"},
    "networks in fp32": {"precision": "fp32"},
    "networks in bf16": {"precision": "bf16"},
}
ABLATION = Plan(
    name="ablation",
    title="One change at a time",
    set=MOMENTUM,
    rows=tuple(Row(label=label, set=changes) for label, changes in CHANGES.items()),
)
"""The paper's design, one choice at a time. A row that changes nothing under the chosen recipe is left out of a run."""

RECIPES_PLAN = Plan(
    name="recipes",
    title="MViTac under each recipe",
    reference="MViTac, modern",
    recipe="modern",
    rows=tuple(Row(label=f"MViTac, {name}", recipe=name) for name in ("paper", "authors", "modern")),
)
"""The recipes unchanged, each with its own budget. Use --set steps=N for equal budgets."""

PLANS = {plan.name: plan for plan in (TABLE1, TABLE2, ABLATION, RECIPES_PLAN)}
