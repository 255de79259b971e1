"""Few labels: the linear probe fitted on a share of the labelled rows. Its kind is named by ``name``."""

from collections.abc import Sequence

import numpy as np

from mvitac.data.pack import Pack
from mvitac.data.spec import AnyTask, Task

ENDING = " % of labels"


def name(percent: float) -> str:
    """The kind of a linear probe that sees this percentage of the labels, such as "10 % of labels"."""
    return f"{percent:g}{ENDING}"


def percent_of(kind: str) -> float:
    """The percentage of labels that a probe of ``kind`` sees; 0 for another kind."""
    return float(kind.removesuffix(ENDING)) if kind.endswith(ENDING) else 0.0


def raised(pack: Pack, task: AnyTask, train: np.ndarray, val: np.ndarray, percents: Sequence[float]) -> list[str]:
    """A line for each of ``percents`` that stands for more of the labels, as ``few`` keeps one of each class."""
    lines, whole = [], len(train) + len(val)
    for percent in percents:
        num = sum(map(len, few(pack, task, train, val, percent, seed=0)))
        if num > sum(round(percent / 100 * len(rows)) for rows in (train, val)):
            lines.append(f"{task.name}: {name(percent)} is {num} of {whole} rows: each kind of label is kept")
    return lines


def few(
    pack: Pack, task: AnyTask, train: np.ndarray, val: np.ndarray, percent: float, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Positions among pack rows ``train`` and ``val`` of those that keep their label, drawn at random.

    There is at least one row of each class; of values, one of each target, and of a single target two different values.
    """
    share = percent / 100
    rng = np.random.default_rng([seed, round(1000 * share)])
    if isinstance(task, Task):
        strata = pack.labels(task.name)
    else:  # which values a row has, and whether they are low
        values = pack.values(task)
        low = (values < np.nanmedian(values[train], axis=0)).any(axis=1)
        strata = np.unique(np.column_stack([np.isnan(values), low]), axis=0, return_inverse=True)[1]

    def some(rows: np.ndarray) -> np.ndarray:
        order = rng.permutation(len(rows))
        _, first = np.unique(strata[rows[order]], return_index=True)  # one of each class, then any
        rest = np.setdiff1d(np.arange(len(rows)), first)
        return np.sort(order[np.concatenate([first, rest])[: max(len(first), round(share * len(rows)))]])

    return some(train), some(val)
