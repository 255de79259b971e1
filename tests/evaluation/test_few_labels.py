"""Few labels: the linear probe on a share of the labelled rows."""

import copy
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from mvitac.cli.main import main
from mvitac.data.pack import Pack
from mvitac.evaluation.few_labels import few
from mvitac.evaluation.probe import split_rows
from mvitac.system.files import read_json


def test_each_share_has_its_rows_and_one_of_each_class(pack: Pack) -> None:
    task = pack.spec.tasks[0]
    rows, labels = split_rows(pack, task), pack.labels("pattern")
    drawn = {}
    for percent in (1, 10, 50):
        train, val = drawn[percent] = few(pack, task, rows.train, rows.val, percent, seed=3)
        assert set(labels[rows.train[train]]) == set(labels[rows.val[val]]) == {0, 1, 2}
        assert len(set(train)) == len(train) == max(3, round(percent / 100 * len(rows.train)))
    assert not np.array_equal(few(pack, task, rows.train, rows.val, 10, seed=4)[0], drawn[10][0])


def test_few_values_keep_two_of_each_target(measured: Pack) -> None:
    pack, task = copy.copy(measured), measured.spec.values[1]
    weight = np.where(np.arange(pack.num) // 3 % 2, np.arange(pack.num), np.nan)  # one row of each group has it
    at = pack.table.column_names.index("weight")
    pack.table = pack.table.set_column(at, "weight", pa.array(weight))
    rows = split_rows(pack, task)
    train, val = few(pack, task, rows.train, rows.val, 1, seed=0)
    for kept in (rows.train[train], rows.val[val]):
        assert np.isfinite(pack.values(task)[kept]).any(0).all()
    assert len(np.unique(pack.values(task)[rows.train[train], 0])) > 1


def test_the_command_shows_few_labels_beside_all(
    smoke_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = ["--tasks", "pattern", "--modalities", "touch", "--json", str(tmp_path / "scores.json")]
    assert main(["probe", str(smoke_run), *asked, "--fractions", "10", "50"]) == 0
    said = capsys.readouterr().out
    assert "(10 % of labels;" in said and "(50 % of labels;" in said
    records = {(r["source"], r["probe"]): r for r in read_json(tmp_path / "scores.json", "")["records"]}
    for source in ("mvitac", "untrained"):
        sizes = {str(records[source, kind]["group_sizes"]) for kind in ("linear", "10 % of labels", "50 % of labels")}
        assert len(sizes) == 1  # the same test rows
        assert records[source, "10 % of labels"]["accuracy"] < records[source, "linear"]["accuracy"] + 0.1
    assert main(["probe", str(smoke_run), "--fractions", "101"]) == 2
    assert "fractions (101.0,): give percentages" in capsys.readouterr().err
