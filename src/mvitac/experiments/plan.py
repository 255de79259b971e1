"""The description of a comparison: rows, tasks, probes, seeds. Plans that ship with the package are in ``plans/``."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from mvitac.data.spec import MODALITIES
from mvitac.datasets.base import DatasetConfig
from mvitac.evaluation.controls import CONTROLS
from mvitac.evaluation.probe_config import Probe
from mvitac.methods.base import MethodConfig
from mvitac.recipes import recipe, with_method
from mvitac.registry import check_known, check_range, default, from_json, to_json, unknown
from mvitac.run import Run
from mvitac.system.files import SEAL, brief, check_ordinary, parse_json, parse_toml

PLANS = ("table1", "table2", "ablation", "recipes")
Printed = dict[str, dict[str, float]]  # modality -> task -> top-1 accuracy in percent as printed in the paper
ONE_ROW = "one row"  # where the pairs of a run are from if its positives are views of the same image, as in the paper


@dataclass(frozen=True, kw_only=True)
class Row:
    """One line of the comparison: a method with its settings, run once per seed."""

    label: str
    method: str = "mvitac"
    recipe: str | None = None
    """A recipe other than the plan's."""
    set: dict[str, Any] = field(default_factory=dict)
    """Fields of the run to change, by dotted name, e.g. {"method.temperature": 0.2, "optim.lr": 0.03}."""
    printed: Printed = field(default_factory=dict)
    """The paper's numbers for this row, with positives of the same image. Shown beside such scores of probe paper only."""


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What is compared with what."""

    name: str
    rows: tuple[Row, ...]
    title: str = ""
    reference: str = "MViTac"
    """Label of the row that all others are compared with."""
    recipe: str = "quick"
    """The recipe of all rows that name none."""
    seeds: int = 3
    """Seeds 0 .. seeds - 1."""
    set: dict[str, Any] = field(default_factory=dict)
    """Fields to change in every row; a row's own changes come after."""
    data: DatasetConfig | None = None
    """The dataset, with its name; --data overrides it."""
    folds: tuple[str, ...] = ()
    """Cross-validation: the data fields of each fold, e.g. ("split=fold1", "split=fold2"). Every row runs on all folds.
    The folds' test groups must differ and are pooled."""
    probes: tuple[Probe, ...] = ("linear",)
    """Probes that score the features; the table shows the first."""
    tasks: tuple[str, ...] = ()
    """Tasks to score. Default: all of the data."""
    modalities: tuple[Literal["touch", "vision", "both"], ...] = ()
    """Modalities to score. Default: all."""
    printed_on: str = ""
    """Name of the dataset of the paper's numbers, with its split: they are shown beside scores on this data only."""
    printed_majority: dict[str, float] = field(default_factory=dict)
    """task -> majority rate as printed in the paper."""

    def __post_init__(self) -> None:
        labels = [row.label for row in self.rows]
        check_range(self, 1, 1000, "seeds")
        fixed = {"seed": "runs have the seeds 0 .. seeds - 1, give their number", "device": "give --device instead"}
        fixed |= {"recipe": "give --recipe, or recipe beside rows in the plan", "method": "a row of the plan names it"}
        fixed |= {"data.score_on": "rows are scored on the same samples, give --data.score-on"}
        given = {name for each in (self.set, *(row.set for row in self.rows)) for name, _ in dotted(each)}
        for name in [name for name in fixed if name in given]:
            raise ValueError(f"{name}: {fixed[name]}")
        folders = [slug(label).encode() for label in labels]
        if not all(folder and len(folder) < 200 for folder in folders) or "*" in "".join(labels):  # of a control
            how = "a label of letters or digits, under 200 bytes, without *"
            raise ValueError(f"plan {self.name!r}: give each row {how}")
        if taken := sorted(set(labels) & set(CONTROLS)):
            raise ValueError(f"row {taken[0]!r} has the name of a control: give it another label")
        if len({*folders}) < len(labels):
            raise ValueError(f"plan {self.name!r}: two labels are one, but for case and punctuation: rename one")
        if not labels:
            raise ValueError(f"plan {self.name!r}: rows is empty, give one or more")
        check_known("reference row", [self.reference], labels)

    def only(self, labels: Sequence[str]) -> "Plan":
        """The plan with only these rows and the reference; all rows if none is given."""
        known = [row.label for row in self.rows]
        check_known("row", labels, known)
        wanted = {*labels, self.reference} if labels else set(known)
        return replace(self, rows=tuple(row for row in self.rows if row.label in wanted))

    def in_folds(self) -> "list[tuple[str, Plan]]":
        """(name, plan) of each fold; the plan itself with an empty name if it has no folds."""
        if not self.folds:
            return [("", self)]
        assert self.data is not None
        whole = recipe(self.recipe, self.data, phased=False)  # for its data alone
        found: dict[str, Plan] = {}
        for fold in self.folds:
            pairs = dict(setting(pair, "fold") for pair in fold.split(","))
            data = changed(whole, {f"data.{name}": value for name, value in pairs.items()}).data
            name = slug(" ".join(map(str, pairs.values())))
            if not name or name in found:
                raise ValueError(f"folds {', '.join(self.folds)}: letters and digits do not tell them apart")
            found[name] = replace(self, data=data, folds=())
        return list(found.items())

    def run(self, row: Row, data: DatasetConfig, seed: int, phased: bool | None = None) -> Run:
        """The run of a row and seed, ``phased`` as for ``recipe``; ValueError if a field or its value does not fit."""
        try:
            base = with_method(recipe(row.recipe or self.recipe, data, phased), row.method)
            methods = {each.method for each in self.rows} & {*MethodConfig.choices}  # another row may name none of them
            known = {f"method.{name}" for method in methods for name in vars(default(MethodConfig, method))}
            lacked = known - {f"method.{name}" for name in vars(base.method)}  # --set means those that have the field
            shared = {name: value for name, value in dotted(self.set) if ".".join(name.split(".")[:2]) not in lacked}
            return replace(changed(base, {**shared, **row.set}), seed=seed)
        except ValueError as error:
            raise ValueError(f"row {row.label!r}: {error}") from None


def find_plan(given: str) -> Plan:
    """A plan by name, or from a .toml or .json file; ValueError if it does not exist or is not valid."""
    path = Path(__file__).parent / "plans" / f"{given}.toml" if given in PLANS else Path(given)
    if path.suffix not in (".toml", ".json"):
        raise unknown("plan", given, [*PLANS, "a .toml file", "a .json file"])
    try:
        check_ordinary(path)  # a pipe never ends
        text = path.read_text()
        value = parse_toml(text) if path.suffix == ".toml" else parse_json(text)
    except FileNotFoundError:
        raise ValueError(f"plan {given} does not exist: choose {', '.join(PLANS)}, or give a file that does") from None
    except (ValueError, RecursionError) as error:
        raise ValueError(f"plan {given} is not valid {path.suffix[1:].upper()}: {brief(error)}") from None
    if not isinstance(value, dict):
        raise ValueError(f"plan {given}: expected an object with name and rows")
    value.pop(SEAL, None)  # of a comparison's plan.json
    return from_json(Plan, {"name": path.stem, **value}, "plan")


def slug(label: str) -> str:
    """A file's name, never a hidden one."""
    return "-".join("".join(c if c.isalnum() or c in ".=" else " " for c in label.lower()).split()).lstrip(".-")


def dotted(changes: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Names and values of ``changes``; a table in a table, as TOML reads an unquoted a.b, is a dotted name."""
    for name, value in changes.items():
        inner = {f"{name}.{key}": v for key, v in value.items()} if isinstance(value, dict) else {}
        yield from dotted(inner) if inner else [(name, value)]


def changed(run: Run, changes: Mapping[str, Any]) -> Run:
    """``run`` with fields changed by dotted name; values as in JSON."""
    value, whole = to_json(run), {}
    for name, new in dotted(changes):
        both = name.startswith("encoder.") and name.count(".") == 1  # short for both modalities
        names = [name.replace(".", f".{m}.") for m in MODALITIES] if both else ["init.path" if name == "init" else name]
        whole |= dict.fromkeys(names, new)
    for name, new in whole.items():
        *path, last = name.split(".")
        inner = value
        for part in path:
            inner = inner.setdefault(part, {}) if isinstance(inner, dict) else {}
        if name in ("method.name", "data.name") or not isinstance(inner, dict):
            raise ValueError(f"{name} is no field that can be changed")
        inner[last] = list(new) if isinstance(new, tuple) else new
    if [name for name in whole if name in ("steps", "epochs")][-1:] == ["epochs"]:  # beside steps it would be ignored
        value["steps"] = None
    return Run.load(value)


def setting(text: str, what: str = "--set") -> tuple[str, Any]:
    """Parse ``field=value``. The value is JSON if it parses as such, else text."""
    name, equals, value = text.partition("=")
    if not equals or not name:
        example = "split=fold1" if what == "fold" else "steps=100 or method.temperature=0.2"
        raise ValueError(f"{what} {text}: give field=value, e.g. {example}")
    try:
        return name, parse_json(f"0{value}" if value.startswith(".") else value)
    except ValueError:
        return name, value
