"""A plan of three rows and two seeds, four steps each, on the striped pairs; a probe's result as a comparison's."""

from dataclasses import replace
from typing import Any

from mvitac.data.pack import Pack
from mvitac.datasets.pack import PackConfig
from mvitac.experiments.plan import Plan, Row
from mvitac.registry import to_json

ROWS = (
    Row(label="MViTac", printed={"touch": {"pattern": 57.6}}),
    Row(label="colder", set={"method.temperature": 0.5}),
    Row(label="supervised, touch", method="supervised", set={"method.modalities": ["touch"]}),
)


def small(pack: Pack, **changes: object) -> Plan:
    plan = Plan(name="small", rows=ROWS, recipe="smoke", seeds=2, set={"steps": 4, "eval_every": 0})
    return replace(plan, data=PackConfig(path=pack.path), **changes)  # type: ignore[arg-type]


def compared(result: dict[str, Any]) -> dict[str, Any]:
    kept: dict[str, Any] = {"left_out": {}, "failed": {}, "unfinished": [], "leaks": "", "cost": [], "commit": None}
    kept |= {"run_commits": [], "run_devices": ["cpu"], "run_precisions": {}, "notes": []}
    plan = Plan(name="one", rows=(Row(label="mvitac"),), reference="mvitac", recipe="smoke", probes=("linear", "knn"))
    return {**result, **kept, "plan": to_json(plan), "rows": ["mvitac"]}
