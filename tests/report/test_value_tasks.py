"""Tasks with values on the terminal, in the report and in comparisons: R2, errors in the unit, pictures, odd cases."""

import csv
import io
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mvitac.data.build import build
from mvitac.data.pack import Pack
from mvitac.data.source import Sample
from mvitac.evaluation.evaluate import ProbeConfig, probe_runs
from mvitac.evaluation.probe import split_rows
from mvitac.evaluation.score_text import cell_text
from mvitac.evaluation.scores import summarise, summarise_again
from mvitac.experiments import table_formats
from mvitac.experiments.table import lines_of, target_lines
from mvitac.report import figures
from mvitac.report.report import write_report
from mvitac.report.sections import Study
from mvitac.report.tables import print_summary
from mvitac.system.files import read_json
from mvitac.training.loop import train
from support.pages import drawings
from support.small_plans import compared
from support.toy import Toy, altered
from support.training_runs import smoke


def one_tested(sample: Sample, item: int) -> dict[str, Any]:
    split = "test" if sample.columns["group"] == "1-4" else "train"
    return {"split": split, "weight": float(item), "label_pattern": None, "label_bright": None}


def scored_run(folder: Path, source: Toy, **session: Any) -> tuple[Path, Pack, dict[str, Any]]:
    pack = build(source, folder / "pack", size=16, workers=1, quiet=True)
    run = smoke(pack, steps=2, eval_every=0, batch_size=8)
    out = train(replace(run, augment=replace(run.augment, size=16)), folder / "run", quiet=True)
    return out, pack, probe_runs([out], ProbeConfig(**session))


@pytest.fixture(scope="module")
def scored(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Pack, dict[str, Any]]:
    return scored_run(tmp_path_factory.mktemp("values"), Toy(values=True), probes=("paper", "linear", "knn"))


def said(result: dict[str, Any], probe: str = "linear") -> str:
    print_summary(result, file := io.StringIO(), probe=probe)
    return file.getvalue()


def test_the_terminal_says_what_each_task_is_scored_by(scored: tuple[Path, Pack, dict[str, Any]]) -> None:
    *_, result = scored
    parts = dict(re.findall(r"^toy: (\w+) \((.*?)(?=^toy: |\Z)", said(result, "paper"), re.M | re.S))
    assert "accuracy %" in parts["pattern"] and "the paper's probe" in parts["pattern"]
    assert "R2 %" in parts["light"] and "ridge regression" in parts["light"]
    assert "accuracy" not in parts["light"] + parts["both"]
    for source in ("mvitac", "untrained", "pixels", "border", "mean", "noise only"):
        assert cell_text(result["summary"]["light"], source, "touch") in parts["light"]
    level, weight = result["summary"]["both"]["touch"]["mvitac"]["targets"]
    assert f"{100 * weight['mean']:.1f}, {weight['mae']:.3g} N" in parts["both"]
    assert f"{100 * level['mean']:.1f}, {level['mae']:.3g} levels" in parts["both"]


def test_a_probe_that_values_lack_does_not_hide_them(scored: tuple[Path, Pack, dict[str, Any]]) -> None:
    """The paper's probe is of classes: values keep their first probe, and are not repeated by a second one."""
    *_, result = scored
    by_paper, ridge, near = (summarise(result["records"], kind) for kind in ("paper", "linear", "knn"))
    assert by_paper["light"] == ridge["light"] != near["light"]
    assert by_paper["pattern"]["touch"]["mvitac"] != ridge["pattern"]["touch"]["mvitac"]
    assert set(summarise_again([r for r in result["records"] if r["probe"] != "knn"], "paper")) == {"pattern", "bright"}
    own = [{**r, "probe": "own"} for r in result["records"] if (r["source"], r["probe"]) == ("mvitac", "knn")]
    again = summarise_again([*result["records"], *own], "own")  # no control has that head
    assert {source for task in again.values() for cells in task.values() for source in cells} == {"mvitac"}


def test_targets_have_scores_of_their_own(scored: tuple[Path, Pack, dict[str, Any]]) -> None:
    *_, result = scored
    cell = summarise(result["records"], "linear")["both"]["touch"]["pixels"]
    names, wanted = ("task", "source", "modality", "probe"), ("both", "pixels", "touch", "linear")
    (record,) = (r for r in result["records"] if tuple(r[name] for name in names) == wanted)
    assert cell["mean"] == pytest.approx(np.mean([target["mean"] for target in cell["targets"]]))
    for found, target in zip(cell["targets"], record["targets"], strict=True):
        scores = target["r2"], target["mae"], target["rmse"]
        assert (found["mean"], found["mae"], found["rmse"]) == pytest.approx(scores)
        assert found["low"] < found["mean"] < found["high"]


def test_the_report_shows_values(scored: tuple[Path, Pack, dict[str, Any]], tmp_path: Path) -> None:
    run, pack, result = scored
    page = write_report([run], tmp_path, result=result, quiet=True).read_text().replace("\xa0", " ")
    drawn_texts = "".join(drawings(page))
    for target in result["summary"]["both"]["touch"]["mvitac"]["targets"]:
        assert f"{target['mae']:.3g} {target['unit']}" in page
    assert cell_text(result["summary"]["light"], "untrained", "vision") in page
    drawn = {file.name for file in (tmp_path / "figures").iterdir()}
    assert {"predicted-light--level.png", "predicted-both--weight.png"} <= drawn
    study = Study([], pack, {}, tmp_path / "alike")
    for name in ("a b", "a-b", "a b", "x" * 240):
        study.figure(name, figures.new_figure("", 1)[0], "")
    assert {file.stem for file in (tmp_path / "alike/figures").iterdir()} == {"a-b", "a-b-2", "x" * 80}
    assert ">R2 %, mean and 95 % interval" in drawn_texts and ">accuracy %, mean and 95 % interval" in drawn_texts


def test_one_test_group_of_values_alone(tmp_path: Path) -> None:
    run, _, result = scored_run(tmp_path, altered(Toy(values=True, vision_channels=0, num=48), one_tested, tasks=()))
    cell = (stored := read_json(run / "probe.json", "scores"))["summary"]["both"]["touch"]["pixels"]
    assert cell["low"] is None and cell["groups"] == 1 and cell["targets"][0]["low"] is None and stored == result
    (run / "probe.json").unlink()  # the report probes values by itself
    text = f"{100 * cell['mean']:.1f}"
    assert cell_text(stored["summary"]["both"], "pixels", "touch") == text and "inf" not in said(stored)
    page = write_report([run], tmp_path / "out", quiet=True).read_text().replace("\xa0", " ")
    assert f"<td>{text}</td>" in page and "1 test instance, so no interval" in page and ">inf" not in page
    assert "balanced accuracy" not in page and "Confusion" not in page
    rows = csv.reader(io.StringIO(table_formats.comma(compared(stored))))
    assert not any(value in ("inf", "-inf", "nan") for row in rows for value in row)


def test_tables_of_a_comparison_have_a_table_of_targets(scored: tuple[Path, Pack, dict[str, Any]]) -> None:
    whole = compared(scored[2])
    lines = lines_of(whole)
    text, tex = table_formats.markdown(whole, lines), table_formats.latex(whole, lines)
    assert "| pattern % | to mvitac | bright % | to mvitac | light R2 % | to mvitac | both R2 % |" in text
    assert "logistic regression or ridge regression on frozen features" in text
    assert r"light R2 \%" in tex and r"pattern \%" in tex and tex.count(r"\begin{tabular}") == 3
    (line,) = (x for x in target_lines(whole)["both"] if (x.source, x.modality) == ("untrained", "touch"))
    weight = line.cells["weight"]
    cell = summarise(whole["records"], "linear")["both"]["touch"]["untrained"]["targets"][1]
    assert (weight["mean"], weight["low"], weight["targets"]) == (cell["mean"], cell["low"], [cell])
    assert weight["difference"]
    for shown in (text, tex):
        assert f"{100 * cell['mean']:.1f} [{100 * cell['low']:.1f}, {100 * cell['high']:.1f}]" in shown
        assert f"{cell['mae']:.3g} N" in shown
    rows = list(csv.DictReader(table_formats.comma(whole).splitlines()))
    key = ("untrained", "touch", "linear", "weight")
    (found,) = (r for r in rows if (r["row"], r["modality"], r["probe"], r["target"]) == key)
    assert (found["task"], found["score"], found["unit"]) == ("both", "R2", "N")
    assert float(found["mae"]) == cell["mae"] and float(found["accuracy"]) == cell["mean"]
    keys = [(r["row"], r["probe"], r["modality"], r["task"], r["target"]) for r in rows]
    assert len(keys) == len(set(keys)) and {r["probe"] for r in rows if r["row"] == "pixels"} == {"linear", "knn"}


def test_figures_cut_off_what_no_axis_can_show() -> None:
    cells = {"good": {"mean": 0.8, "low": 0.7, "high": 0.9}, "bad": {"mean": -40.0, "low": -90.0, "high": -3.0}}
    unknown = {"mean": 0.2, "low": None, "high": 1.0}
    drawn = figures.bars("force", {"touch": {**cells, "one": unknown}}, {"mean": -0.01}, "R2 %")
    left, right = drawn.axes[0].get_xlim()
    assert left == 100 * figures.LEAST and 90 < right < 130
    assert "-4000.0" in {text.get_text() for text in drawn.axes[0].texts}
    whiskers = [line.get_xdata() for line in drawn.axes[0].lines if line.get_linestyle() == "-"]
    assert [20, 20] not in [list(x) for x in whiskers]


def test_predictions_that_are_exact_lie_on_the_line() -> None:
    (axes,) = figures.predicted("force", [[0, 0], [2, 2], [4, 1000]], "N", "blue").axes
    (line,) = axes.lines
    assert list(line.get_xdata()) == list(line.get_ydata()) and axes.get_xlim() == axes.get_ylim()
    at = axes.collections[0].get_offsets()
    assert at[:2].tolist() == [[0, 0], [2, 2]] and at[2, 1] == axes.get_ylim()[1]  # far off: at the edge
    assert axes.get_xlabel() == "true, N"


def test_a_target_without_values_in_test_is_named(tmp_path: Path) -> None:
    def untested(sample: Sample, item: int) -> dict[str, Any]:
        return {"weight": float("nan") if sample.columns["split"] == "test" else float(item)}

    pack = build(altered(Toy(values=True), untested), tmp_path / "pack", size=16, workers=1, quiet=True)
    with pytest.raises(ValueError, match="task 'both': weight has fewer than two different values in split test"):
        split_rows(pack, pack.spec.values[1])
    assert len(split_rows(pack, pack.spec.values[0]).test)
