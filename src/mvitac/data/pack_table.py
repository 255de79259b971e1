"""What every reader of a pack's table relies on, checked."""

from collections import Counter

import numpy as np
import pyarrow as pa

from mvitac.data.spec import DataSpec
from mvitac.registry import check_known

SPLITS = ("train", "val", "test", "unlabelled")
"""Pre-training uses train and unlabelled. Val is for choosing (kNN during training, a probe's C), test for scores only."""


def check_table(table: pa.Table, spec: DataSpec) -> None:
    """Check what every reader of a pack's table relies on; ValueError names the column, the row and what is allowed."""
    labels = {f"label_{task.name}": len(task.classes) for task in spec.tasks}
    controls = [c for columns in spec.controls.values() for c in columns]
    targets = {target.name: target for task in spec.values for target in task.targets}
    asked = (*labels, *controls, *targets, *(c for task in spec.all_tasks for c in task.only))
    check_known("column", ("id", "group", "split", *asked), table.column_names)
    for name in ("id", "group", "split", "touch_group", *labels):
        if name in table.column_names and table.column(name).null_count:
            row = table.column(name).is_null().to_numpy().argmax()  # the first
            raise ValueError(f"column {name} is empty in row {row}: every row needs one")
    for name in (f"has_{modality}" for modality in spec.modalities):
        if name in table.column_names and (table.column(name).null_count or table.column(name).type != pa.bool_()):
            raise ValueError(f"column {name} holds {table.column(name).type}: write true or false in every row")
    for name in spec.split_columns:
        check_known("column", [name], table.column_names)
        check_known(name, map(str, table.column(name).unique().to_pylist()), SPLITS)
    for name, num in labels.items():
        column = table.column(name)
        if not pa.types.is_integer(column.type):
            raise ValueError(f"column {name} holds {column.type}: a label is 0 to {num - 1}, or -1 for none")
        values = column.to_numpy()
        if (bad := (values < -1) | (values >= num)).any():
            row = bad.argmax()
            raise ValueError(f"{name} is {values[row]} in row {row}: give 0 to {num - 1}, or -1 for none")
    for name in controls:
        _check_numbers(table.column(name), name, "a control needs a number in every row", gaps=False)
    for name in targets:
        _check_numbers(table.column(name), name, "a value is a finite number, or NaN for none", gaps=True)
    for one, times in Counter(table.column("id").to_pylist()).most_common(1):
        if times > 1:
            raise ValueError(f"id {one!r} occurs twice: give every sample its own")


def _check_numbers(column: pa.ChunkedArray, name: str, need: str, *, gaps: bool) -> None:
    kind = column.type
    if not (pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_boolean(kind)):
        raise ValueError(f"column {name} holds {kind}: {need}")
    values = column.to_numpy(zero_copy_only=False).astype(float)
    if (bad := np.isinf(values) if gaps else ~np.isfinite(values)).any():
        raise ValueError(f"column {name} is {values[bad.argmax()]} in row {bad.argmax()}: {need}")
