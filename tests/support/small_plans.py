"""A plan of three rows and two seeds, four steps each, on the striped pairs."""

from dataclasses import replace

from mvitac.data.pack import Pack
from mvitac.datasets.pack import PackConfig
from mvitac.experiments.plan import Plan, Row

ROWS = (
    Row(label="MViTac", printed={"touch": {"pattern": 57.6}}),
    Row(label="colder", set={"method.temperature": 0.5}),
    Row(label="supervised, touch", method="supervised", set={"method.modalities": ["touch"]}),
)


def small(pack: Pack, **changes: object) -> Plan:
    plan = Plan(name="small", rows=ROWS, recipe="smoke", seeds=2, set={"steps": 4, "eval_every": 0})
    return replace(plan, data=PackConfig(path=pack.path), **changes)  # type: ignore[arg-type]
