"""A plan becomes a table: finished runs are skipped, killed ones resumed to the same bits, p is what it says."""

import csv
import json
import os
import re
import shutil
import signal
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from mvitac.cli.main import main
from mvitac.data.build import build
from mvitac.data.pack import Pack
from mvitac.data.row_hashes import split_leaks
from mvitac.datasets.base import DatasetConfig
from mvitac.datasets.pack import ON_VAL, PackConfig
from mvitac.datasets.simulated import MaterialsConfig
from mvitac.evaluation.evaluate import ProbeConfig
from mvitac.evaluation.score_text import pipes
from mvitac.experiments import collect, jobs
from mvitac.experiments.collect import cost, gather, lay_out, pairs_of
from mvitac.experiments.cross_validation import lay_out_folds
from mvitac.experiments.jobs import do_all
from mvitac.experiments.plan import PLANS, Plan, Row, changed, find_plan, setting, slug
from mvitac.experiments.table import as_printed, lines_of
from mvitac.experiments.table_formats import _budget, _tabular, comma, latex, markdown, write_tables
from mvitac.recipes import RECIPES, recipe
from mvitac.registry import from_json
from mvitac.system.locks import Busy, hold_lock
from mvitac.training.loop import Interrupted, train
from mvitac.training.step import Step
from support.processes import begin, finish
from support.small_plans import ROWS, small
from support.toy import Toy, altered, toy_pack, with_columns
from support.videos import picture

TABLE1, TABLE2, ABLATION = map(find_plan, PLANS[:3])
EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture(scope="module")
def done(pack: Pack, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict]:
    out = tmp_path_factory.mktemp("compare") / "out"
    do_all(work := lay_out(small(pack), pack, out, ProbeConfig()), quiet=True)
    write_tables(result := gather(work, out, ProbeConfig()), out)
    return out, result


@pytest.mark.parametrize("name", PLANS)
@pytest.mark.parametrize("recipe_name", RECIPES)
def test_every_row_of_every_plan_is_a_run(name: str, recipe_name: str) -> None:
    plan = replace(find_plan(name), recipe=recipe_name, set={"method": {"temperature": 0.3}})
    for row in plan.rows:
        run = plan.run(row, MaterialsConfig(), 7)
        assert getattr(run.method, "temperature", 0.3) == row.set.get("method.temperature", 0.3)
        assert run.seed == 7 and run.method.name == row.method
        for field, value in row.set.items():
            found: object = run
            for part in field.split("."):
                found = getattr(found, part)
            assert found == (tuple(value) if isinstance(value, list) else value), (row.label, field)


def test_table1_has_one_budget_and_ablation_leaves_out_what_changes_nothing(pack: Pack, tmp_path: Path) -> None:
    work = lay_out(small(pack, rows=TABLE1.rows), pack, tmp_path, ProbeConfig())
    assert set(work.left_out) == {"TAG (CMC), its own tau .07"} and len(work.jobs) == 32  # smoke changes no tau
    assert {(job.run.steps, job.run.batch_size, job.run.optim.lr) for job in work.jobs} == {(4, 16, 2e-3)}
    assert [job.run.seed for job in work.jobs] == [0] * 16 + [1] * 16
    work = lay_out(small(pack, rows=ABLATION.rows), pack, tmp_path, ProbeConfig())
    assert "no grayscale" in work.left_out and "the same run as 'MViTac'" in work.left_out["no grayscale"]
    assert "grayscale .2" not in work.left_out
    assert "touch flips" in work.left_out  # these are the recipe's
    assert "'pack' has no data.difference" in work.left_out["difference images of touch"]
    assert len(set(digests := [job.run.digest() for job in work.jobs])) == len(digests)
    with pytest.raises(ValueError, match="'pattern' has no labelled rows in split test: nothing to probe"):
        lay_out(small(pack), with_columns(pack, split=["train"] * pack.num), tmp_path, ProbeConfig())
    with pytest.raises(ValueError, match="batch_size is 999: give --set batch_size=72 or less"):
        lay_out(small(pack, rows=ABLATION.rows, set={"batch_size": 999}), pack, tmp_path, ProbeConfig())
    rows = (Row(label="MViTac"), Row(label="b", set={"batch_size": 999}))
    own = lay_out(small(pack, rows=rows), pack, tmp_path, ProbeConfig())
    assert own.left_out["b"].endswith("batch_size is 999: give batch_size=72 or less")


def test_rows_the_data_does_not_allow_are_told(tmp_path: Path) -> None:
    pack = toy_pack(tmp_path / "touch-only", vision_channels=0)
    work = lay_out(small(pack, rows=TABLE1.rows), pack, tmp_path / "out", ProbeConfig())
    assert "learns from pairs" in work.left_out["TAG (CMC)"]
    assert "unknown modality" in work.left_out["supervised, vision only"]
    assert "the same run as 'supervised, touch only'" in work.left_out["supervised, both"]
    assert "the same run as 'MViTac, end-to-end'" in work.left_out["MViTac, end-to-end, all pairs"]
    assert "MViTac, end-to-end, all pairs, no touch flips" not in work.left_out
    assert {job.label for job in work.jobs} >= {"MViTac", "MoCo per modality", "supervised, touch only"}
    work = lay_out(small(pack, rows=ABLATION.rows), pack, tmp_path / "out", ProbeConfig())
    for label in ("lambda_inter 2.0", "losses tt", "losses vv + tt"):
        assert "the same run as 'MViTac'" in work.left_out[label]
    assert "the same run as 'no flips'" in work.left_out["no touch flips"]
    assert "lacks a modality" in work.left_out["losses vv"]
    wrong: dict[str, object] = {"method.tau": 1}
    unknown = "row 'MViTac': unknown"
    for method, fields, words in (("cmc", {}, "no row that"), ("moc", {}, unknown), ("moco", wrong, unknown)):
        plan = small(pack, rows=(Row(label="MViTac", method=method, set=fields),))
        with pytest.raises(ValueError, match=words):
            lay_out(plan, pack, tmp_path / "out", ProbeConfig())


def test_a_row_may_read_the_same_samples_in_another_way(pack: Pack, tmp_path: Path) -> None:
    """As difference images are: trained and scored on its own pack, beside the others; other samples are refused."""
    dark = altered(Toy(), lambda sample, _: {"touch": sample.touch // 2})
    darker = build(dark, tmp_path / "darker", size=32, quiet=True)
    rows = (
        Row(label="MViTac"),
        Row(label="darker", set={"data.path": str(darker.path)}),
        Row(label="fewer", set={"data.path": str(toy_pack(tmp_path / "fewer", num=90).path)}),
    )
    session = ProbeConfig(tasks=("pattern",), modalities=("touch",), controls=False)
    work = lay_out(small(pack, rows=rows, seeds=1), pack, tmp_path / "out", session)
    assert list(work.left_out) == ["fewer"] and "another column id" in work.left_out["fewer"]
    do_all(work, quiet=True)
    packs = {job.label: json.loads((job.out / "run.json").read_text())["pack"] for job in work.jobs}
    assert packs == {"MViTac": pack.digest, "darker": darker.digest}
    result = gather(work, tmp_path / "out", session)
    assert {"MViTac", "darker"} <= {record["source"] for record in result["records"]}
    assert result["notes"] == ["darker reads other images than the controls"]


def test_a_row_may_not_read_other_values(tmp_path: Path) -> None:
    pack = toy_pack(tmp_path / "pack", values=True)
    column = pack.spec.values[0].targets[0].name
    lit = altered(Toy(values=True), lambda sample, _: {column: sample.columns[column] + 1})
    other = build(lit, tmp_path / "other", size=32, quiet=True)
    text = build(altered(Toy(), lambda *_: {column: "a"}), tmp_path / "text", size=32, quiet=True)
    rows = (Row(label="MViTac"), *(Row(label=p.path.name, set={"data.path": str(p.path)}) for p in (other, text)))
    work = lay_out(small(pack, rows=rows, seeds=1), pack, tmp_path / "out", ProbeConfig())
    assert all(f"another column {column}" in work.left_out[label] for label in ("other", "text"))


def test_scores_that_were_copied_from_another_run_are_computed_again(
    done: tuple[Path, dict], pack: Pack, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = shutil.copytree(done[0], tmp_path / "out")
    one, two = sorted(out.rglob("scores.json"))[:2]
    right = [record["group_correct"] for record in json.loads(two.read_text())["records"]]
    shutil.copy(one, two)
    monkeypatch.setattr(Step, "__call__", None)  # nothing is trained again
    do_all(work := lay_out(small(pack), pack, out, ProbeConfig()), quiet=True)
    assert [record["group_correct"] for record in json.loads(two.read_text())["records"]] == right
    assert all(job.done for job in work.jobs)
    for file in (two, two.with_name("failed.json"), out / "controls.json"):  # JSON of another kind
        file.write_text("{}")
        with pytest.raises(ValueError, match=f"{file.name} is damaged"):
            gather(work, out, ProbeConfig())
        file.unlink()


@pytest.mark.parametrize("file", sorted(EXAMPLES.glob("*.toml")), ids=lambda file: file.stem)
def test_plans_of_the_examples_name_settings_that_exist(file: Path) -> None:
    for row in (plan := find_plan(str(file))).rows:
        if not any(name.startswith("data.") for name in row.set):
            plan.run(row, PackConfig(), 0, phased=False)


@pytest.mark.parametrize("name", ["force", "pose"])
def test_methods_of_these_plans_see_equally_many_images(pack: Pack, name: str) -> None:
    plan = find_plan(str(EXAMPLES / f"{name}.toml"))
    spec, seen = replace(pack.spec, vision_channels=0), {}
    for row in plan.rows:
        run = plan.run(row, PackConfig(), 0, phased=False)
        if not run.method.needs_pairs and row.label not in ("ViT, not trained", "supervised, 96 px"):
            seen[row.label] = (run.steps or 0) * run.batch_size * run.method.on_tiny_trunk(spec, run.encoder).views
    assert len(seen) > 8 and len(set(seen.values())) == 1, seen


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("rows = [", "not valid TOML"),
        ("[[rows]]", "plan.rows: give label, too"),
        ("rows = []", "plan 'p': rows is empty, give one or more"),
        ('[[rows]]\nlabel = "a"', "unknown reference row 'MViTac'"),
        ('reference = "a"\n[[rows]]\nlabel = "a"\ntau = 1', "unknown field in plan.rows 'tau'"),
        ('reference = "a"\n[[rows]]\nlabel = "a"\n[[rows]]\nlabel = "A"', "two labels are one"),
        ('reference = "a"\n[[rows]]\nlabel = "a"\nset = {seed = 3}', "runs have the seeds 0"),
        ('reference = "a"\nset = {device = "cpu"}\n[[rows]]\nlabel = "a"', "device: give --device instead"),
        ('reference = "a"\n[[rows]]\nlabel = "a"\nset = {recipe = "paper"}', "recipe: give --recipe"),
        ('reference = "a"\nset = {data.score_on = "val"}\n[[rows]]\nlabel = "a"', "give --data.score-on"),
        ('reference = ".."\n[[rows]]\nlabel = ".."', "a label of letters or digits"),
        (f'reference = "a"\n[[rows]]\nlabel = "{"é" * 100}"', "under 200 bytes, without \\*"),
        ('reference = "pixels"\n[[rows]]\nlabel = "pixels"', "row 'pixels' has the name of a control"),
    ],
)
def test_damaged_plans_are_one_line(tmp_path: Path, text: str, says: str) -> None:
    (tmp_path / "p.toml").write_text(text)
    with pytest.raises(ValueError, match=says):
        find_plan(str(tmp_path / "p.toml"))


def test_some_rows_of_a_plan_stand_beside_its_reference() -> None:
    assert [row.label for row in TABLE1.only(["SSVTP", "TAG (CMC)"]).rows] == ["TAG (CMC)", "SSVTP", "MViTac"]
    assert TABLE1.only([]) == TABLE1
    with pytest.raises(ValueError, match="unknown row 'ssvtp': choose from"):
        TABLE1.only(["ssvtp"])


def test_changed_fields_are_checked() -> None:
    run = recipe("smoke")
    assert changed(run, {"optim.lr": 1, "steps": 7}).optim.lr == 1.0
    assert changed(run, {"data.num_frames": 4}).data.num_frames == 4  # not written to files at its default
    assert changed(run, {}) == run and replace(TABLE1, set={"method": {"temperature": 0.2}}).set
    row = Row(label="MViTac", set={"epochs": 2})
    assert run.steps and replace(TABLE1, set={"steps": 7}).run(row, MaterialsConfig(), 0).steps is None
    assert changed(run, {"epochs": 2, "steps": 5}).steps == 5
    for name in ("optim.lrr", "steps.more", "nothing", "method.name", "optim"):
        with pytest.raises(ValueError, match=name.split(".")[-1]):
            changed(run, {name: 3})
    with pytest.raises(ValueError, match="expected int"):
        changed(run, {"steps": "many"})
    with pytest.raises(ValueError, match="row 'MViTac': temperature"):
        TABLE1.run(Row(label="MViTac", set={"method.temperature": -1.0}), MaterialsConfig(), 0)
    assert setting("optim.lr=1e-3") == ("optim.lr", 1e-3)
    assert setting("encoder.weights=scratch") == ("encoder.weights", "scratch")
    with pytest.raises(ValueError, match="field=value"):
        setting("steps")
    assert slug("Calandra et al., supervised") == "calandra-et-al.-supervised" and slug("../../x") == "x"


def test_result_and_tables_agree(done: tuple[Path, dict]) -> None:
    out, result = done
    assert {p.name for p in out.glob("table.*")} == {f"table.{end}" for end in ("md", "tex", "csv")}
    lines = {(line.source, line.modality): line for line in lines_of(result)}
    touch = lines["MViTac", "touch"].cells["pattern"]
    keys, wanted = ("source", "modality", "task", "probe"), ("MViTac", "touch", "pattern", "linear")
    own = [r for r in result["records"] if tuple(r[key] for key in keys) == wanted]
    assert len(own) == 2 and touch["mean"] == pytest.approx(np.mean([r["accuracy"] for r in own]))
    assert touch["printed"] is None and touch["difference"] is None
    assert ("supervised, touch", "vision") not in lines and ("supervised, touch", "touch") in lines
    assert lines["supervised, touch, end to end", "touch"].cells["pattern"]["difference"] is not None
    assert {"majority", "untrained", "pixels", "border", "noise only"} <= {line.source for line in lines.values()}
    text = (out / "table.md").read_text()
    assert f"| MViTac | touch | {100 * touch['mean']:.1f} [" in text
    assert "equal budget: every run saw 64 pairs in 4 steps" in text and "LEAK" not in text
    plan = json.loads((out / "result.json").read_text())["plan"]
    plan["rows"][1]["set"] = {"init": "run"}
    assert "is what the weights that colder started from had seen" in _budget({**result, "plan": plan})
    rows = list(csv.DictReader((out / "table.csv").read_text().splitlines()))
    assert len(rows) == sum(len(line.cells) for line in lines.values())
    found = next(r for r in rows if (r["row"], r["modality"], r["task"]) == ("colder", "both", "bright"))
    assert float(found["accuracy"]) == lines["colder", "both"].cells["bright"]["mean"]
    tex = (out / "table.tex").read_text()
    assert tex.count(r"\\") == len(lines) + 1 and "printed" not in tex and r"\textit{pixels}" in tex
    assert json.loads((out / "result.json").read_text())["rows"] == ["MViTac", "colder", "supervised, touch"]


@pytest.mark.parametrize(
    ("data", "probe", "pairs", "shown"),
    [
        ("touch-and-go (official)", "paper", "one row", True),
        ("touch-and-go (official, partial)", "paper", "one row", False),
        ("touch-and-go (official)", "linear", "one row", False),
        ("touch-and-go (official)", "paper", "two rows of a touch", False),
    ],
)
def test_where_printed_numbers_stand(done: tuple[Path, dict], data: str, probe: str, pairs: str, shown: bool) -> None:
    """Beside scores of the same split, probe and positives."""
    result = json.loads(json.dumps(done[1]))
    result["plan"] |= {"printed_on": "touch-and-go (official)", "printed_majority": {"pattern": 18.6}}
    result["plan"] |= {"probes": [probe]}
    result["data"] = data
    for record in result["records"]:
        record["probe"] = probe if record["source"] in ("MViTac", "colder", "untrained") else record["probe"]
    for cost_ in result["cost"]:
        cost_["pairs_of"] = pairs if cost_["row"] == "MViTac" else "one row"
    lines = lines_of(result)
    plan = from_json(Plan, result["plan"], "plan")
    assert as_printed(result, plan) == (data == "touch-and-go (official)")
    assert not as_printed({**result, "notes": [ON_VAL]}, plan)
    cells = [(line.source, task, cell["printed"]) for line in lines for task, cell in line.cells.items()]
    found = {(source, task): printed for source, task, printed in cells if printed}
    same = probe == "paper" and data == "touch-and-go (official)"
    assert found.pop(("MViTac", "pattern"), None) == (57.6 / 100 if shown else None)
    assert found.pop(("majority", "pattern"), None) == (18.6 / 100 if same else None) and not found
    text = markdown(result, lines)
    assert ("57.6" in text) == ("57.6" in latex(result, lines)) == ("0.576" in comma(result)) == shown
    assert ("by the same probe and positives" in text) == same
    assert ("`--probes paper` shows them" in text) == (probe == "linear")


def test_finished_runs_are_not_done_again(done: tuple[Path, dict], pack: Pack, monkeypatch: pytest.MonkeyPatch) -> None:
    out, result = done
    assert len(list(out.rglob("model.safetensors"))) == 6 and not list(out.rglob("checkpoint.pt"))
    monkeypatch.setattr(jobs, "train", None)  # calling it would raise
    monkeypatch.setattr(collect, "controls_of", None)
    do_all(work := lay_out(small(pack), pack, out, ProbeConfig()), quiet=True)
    assert gather(work, out, ProbeConfig()) == json.loads(json.dumps(result))


def test_controls_are_made_again_where_the_data_names_others(
    done: tuple[Path, dict], pack: Pack, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of the same pixels and columns: the pack's digest is the same."""
    out = shutil.copytree(done[0], tmp_path / "out")
    other = with_columns(pack, spec=replace(pack.spec, controls={"noise": ("noise",)}))
    monkeypatch.setattr(collect, "controls_of", lambda *_: ([], []))
    for data, kept in ((pack, True), (other, False)):
        result = gather(lay_out(small(pack), data, out, ProbeConfig()), out, ProbeConfig())
        assert any(record["source"] == "noise only" for record in result["records"]) == kept


def test_a_run_that_diverges_is_told_and_the_rest_goes_on(pack: Pack, tmp_path: Path) -> None:
    wild = Row(label="wild", set={"optim.name": "sgd", "optim.lr": 1e30, "log_every": 1})
    work = lay_out(small(pack, rows=(ROWS[0], wild), seeds=1), pack, tmp_path, ProbeConfig(controls=False))
    do_all(work, quiet=True)
    result = gather(work, tmp_path, ProbeConfig(controls=False))
    assert "not finite" in result["failed"]["wild, seed 0"]
    assert "Diverged: wild, seed 0" in write_tables(result, tmp_path)[0].read_text()
    assert {record["source"] for record in result["records"]} == {"MViTac"}
    lost = replace(work, jobs=[job for job in work.jobs if job.label == "wild"])
    says = r"no run of .* is finished with probes linear: .*; wild, seed 0: the loss is not"
    with pytest.raises(ValueError, match=says):
        gather(lost, tmp_path, ProbeConfig(controls=False))


@pytest.mark.parametrize("stop", [Interrupted("stopped after step 3"), KeyboardInterrupt()])
def test_ctrl_c_begins_no_run(pack: Pack, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stop: BaseException) -> None:
    """Of the run under way, training saves a checkpoint: ``test_ctrl_c_saves_and_is_told``."""
    work = lay_out(small(pack, seeds=1), pack, tmp_path, ProbeConfig(controls=False))
    monkeypatch.setattr(jobs, "train", begun := Mock(side_effect=stop))
    with pytest.raises(Interrupted, match="stopped; the same command continues from here"):
        do_all(work, quiet=True)
    assert begun.call_count == 1 < len(work.jobs)


def test_a_run_that_fails_is_told_and_the_others_go_on(
    done: tuple[Path, dict], pack: Pack, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    work = lay_out(small(pack, rows=ROWS[:2], seeds=1, set={"steps": 3}), pack, tmp_path, ProbeConfig(controls=False))
    shutil.copytree(done[0] / "runs/mvitac/seed0", work.jobs[0].out)
    (work.jobs[0].out / "scores.json").unlink()
    with pytest.raises(ValueError, match=r"holds a different run .*"):
        do_all(work, quiet=True)
    assert re.search(r"\[0/2\] MViTac, seed 0: failed: .* holds a different run", capsys.readouterr().out)
    assert [job.done for job in work.jobs] == [False, True]


def test_what_another_process_does_is_left(pack: Pack, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """As when the same command runs on two machines; here a thread is the other one."""
    work = lay_out(small(pack, rows=ROWS[:2], seeds=1), pack, tmp_path, ProbeConfig(controls=False))
    begun, go = threading.Event(), threading.Event()

    def other() -> None:
        with hold_lock(work.jobs[0].out, "", wait=False):
            begun.set()
            go.wait(60)

    with ThreadPoolExecutor(1) as threads:
        held = threads.submit(other)
        assert begun.wait(60)
        with pytest.raises(Busy, match="is being trained by another process"):
            train(work.jobs[0].run, work.jobs[0].out, pack=pack)
        do_all(work, quiet=True)
        assert "[0/2] MViTac, seed 0: another process runs it" in capsys.readouterr().out
        assert [job.done for job in work.jobs] == [False, True] and not work.jobs[0].out.exists()
        go.set()
        held.result()
    text = write_tables(gather(work, tmp_path, ProbeConfig(controls=False)), tmp_path)[0].read_text()
    assert "**Not finished: MViTac, seed 0.**" in text
    do_all(work, quiet=True)
    assert [job.done for job in work.jobs] == [True, True] and not list(tmp_path.rglob("*.lock"))


def test_other_settings_in_the_same_folder_are_refused(done: tuple[Path, dict], pack: Pack, tmp_path: Path) -> None:
    """Before anything is trained or told, though all runs are finished."""
    out, _ = done
    with pytest.raises(ValueError, match="mvitac/seed0 holds a different run"):
        lay_out(small(pack, set={"steps": 5, "eval_every": 0}), pack, out, ProbeConfig())
    other = toy_pack(tmp_path / "other", num=90)
    with pytest.raises(ValueError, match="mvitac/seed0 holds a different run"):
        lay_out(small(other), other, out, ProbeConfig())


def test_other_probes_score_finished_runs_again(pack: Pack, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = (ProbeConfig(controls=False, probes=probes) for probes in (("linear",), ("knn", "linear")))
    plan = small(pack, rows=ROWS[:1], seeds=1)
    do_all(work := lay_out(plan, pack, tmp_path, first), quiet=True)
    linear = gather(work, tmp_path, first)["records"]
    monkeypatch.setattr(Step, "__call__", None)  # nothing is trained again
    work = lay_out(plan, pack, tmp_path, second)
    assert not work.jobs[0].done
    do_all(work, quiet=True)
    both = gather(work, tmp_path, second)["records"]
    assert work.jobs[0].done and {record["probe"] for record in both} == {"knn", "linear"}
    assert [record for record in both if record["probe"] == "linear"] == linear


def test_tables_say_where_pairs_are_from(done: tuple[Path, dict], pack: Pack) -> None:
    said = {
        (positives, views): pairs_of(replace(recipe("smoke", pack), positives=positives), views, pack)
        for positives in ("same-image", "same-touch", "same-touch-pairs")
        for views in (1, 2)
    }
    two = {key for key, words in said.items() if words == "two rows of a touch"}
    assert two == {("same-touch", 2), ("same-touch-pairs", 1), ("same-touch-pairs", 2)}
    assert set(said.values()) == {"two rows of a touch", "one row"}
    for other in ("one row", "two rows of a touch"):
        costs = [{**c, "pairs_of": other if c["row"] == "MViTac" else "one row"} for c in done[1]["cost"]]
        text = markdown({**done[1], "cost": costs, "data": "<script>"}, lines_of(done[1]))
        assert "Data &lt;script>" in text and "Too few" not in text
        assert ("**pairs are not from the same rows (see cost)**" in text) == (other != "one row")
        assert f"| {other} |" in text
    next(iter((lines := lines_of(done[1]))[0].cells.values())).update(low=None, high=1.0)
    assert "Controls are in italics. Too few test" in markdown(done[1], lines)


def test_cost_counts_images_and_seconds_and_notes_stand_beside_it(done: tuple[Path, dict], pack: Pack) -> None:
    out, result = done
    by_row = {c["row"]: c for c in result["cost"]}
    assert by_row["MViTac"]["images"] == 4 * 16 * 2 * 2 and by_row["supervised, touch"]["images"] == 4 * 16
    assert by_row["MViTac"]["pairs"] == by_row["supervised, touch"]["pairs"] == 64
    assert all(0 < c["seconds"] < 60 for c in result["cost"])
    work = lay_out(small(pack), pack, out, ProbeConfig())
    assert cost("MViTac", work.jobs[:1], pack)["trained_parameters"] > 100_000
    noted = with_columns(pack, spec=replace(pack.spec, notes=("half of it\nis the same",)))
    result = gather(replace(work, pack=noted), out, ProbeConfig())
    lines = lines_of(result)
    assert "\nNote: half of it is the same.\n" in markdown(result, lines)
    assert latex(result, lines).splitlines()[1] == "% Note: half of it is the same."


def test_a_leak_of_a_tasks_own_split_is_flagged(pack: Pack) -> None:
    """Every fourth row is tested: its group's other row is learned from."""
    pattern, bright = pack.spec.tasks
    own = with_columns(pack, split_bright=np.where(np.arange(pack.num) % 4 == 0, "test", "train"))
    task = replace(bright, split="split_bright")
    said = split_leaks(own, [pattern, task])
    assert said == {"split_bright": "30 of 30 test instances of bright are also in train: this split leaks"}
    assert split_leaks(own, [pattern]) == {}  # nothing that is scored
    for side in ("train", "test"):  # without labels there
        labels = np.where(own.column("split_bright") == side, -1, own.labels("bright"))
        assert split_leaks(with_columns(own, label_bright=labels), [pattern, task]) == {}


def test_names_and_units_are_text_in_latex_and_markdown() -> None:
    text = _tabular(["", "modality", "a & b %"], [["\\input{x} N%$_^~", "touch", "50.0 [40.0, 60.0]"]])
    assert r"\textbackslash{}input\{x\} N\%\$\_\^{}\textasciitilde{}" in text and r"a \& b \%" in text
    assert r"50.0 [40.0, 60.0]" in text
    assert " {}[1] a\\textbar{}b & touch" in _tabular(["", ""], [["[1] a|b", "touch"]])
    assert pipes(["a|b"], [["c|d"]], words=1) == [r"| a\|b |", "|---|", r"| c\|d |", ""]


def command(pack: Pack, plan: Path, out: Path, *more: str) -> list[str]:
    return ["compare", "--plan", str(plan), "--data", "pack", "--data.path", str(pack.path), "--out", str(out), *more]


def write_plan(path: Path, num_rows: int, seeds: int, steps: int) -> Path:
    rows = [{"label": f"tau {i}", "set": {"method.temperature": 0.1 + 0.1 * i}} for i in range(num_rows)]
    common = {"steps": steps, "eval_every": 0, "checkpoint_every": 1, "log_every": 1}
    plan = {"rows": rows, "reference": "tau 0", "recipe": "smoke", "seeds": seeds, "set": common, "tasks": ["pattern"]}
    path.write_text(json.dumps({**plan, "modalities": ["touch"]}))
    return path


def table(out: Path) -> tuple[str, str]:
    """The whole CSV, and the Markdown without the times it took and the commit, which may be made meanwhile."""
    text = re.sub(r"; (code|runs at) .*", "", (out / "table.md").read_text())
    return (out / "table.csv").read_text(), text[: text.index("| cost of one run")]


@pytest.mark.slow
def test_killed_and_shared_gives_the_same_table(pack: Pack, tmp_path: Path) -> None:
    """One process is killed in its first run. Two others go on, and share the runs of the command."""
    plan, out = write_plan(tmp_path / "plan.json", 2, 1, 8), tmp_path / "out"
    finish(begin(main, command(pack, plan, tmp_path / "straight")))
    shown = [tmp_path / f"{i}.txt" for i in range(3)]
    first = begin(main, command(pack, plan, out), output=shown[0])
    while first.is_alive():
        if sum(len(log.read_text().splitlines()) for log in out.glob("runs/*/*/log.jsonl")) >= 2:
            first.kill()
            first.join()
        time.sleep(0.005)
    assert first.exitcode == -signal.SIGKILL and not (out / "table.md").exists()
    for process in [begin(main, command(pack, plan, out), output=file) for file in shown[1:]]:
        finish(process)
    assert sum(file.read_text().count("s of training") for file in shown) == 2
    assert table(out) == table(tmp_path / "straight")


def test_the_command_from_dry_run_to_tables(pack: Pack, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = command(pack, write_plan(tmp_path / "plan.json", 2, 1, 2), tmp_path / "out")
    assert main([*words, "--dry-run"]) == 0
    shown = capsys.readouterr().out
    assert "2 rows x 1 seeds = 2 runs" in shown and not (tmp_path / "out").exists() and "2 runs left" in shown
    os.mkfifo(tmp_path / "pipe.toml")
    assert main(["compare", "--plan", str(tmp_path / "pipe.toml"), "--dry-run"]) == 2
    assert "pipe.toml is neither a file nor a folder" in capsys.readouterr().err
    (own := tmp_path / "out/table.csv").parent.mkdir()
    own.write_text("mine")
    assert main(words) == 2 and "is not empty, and holds no comparison" in capsys.readouterr().err
    assert own.read_text() == "mine"
    own.unlink()
    assert main([*words, "--tables-only"]) == 2 and "no run of" in capsys.readouterr().err
    assert main([*words, "--set", "steps=1", "--seeds", "1"]) == 0
    shown = capsys.readouterr().out
    assert "[2/2] tau 1, seed 0" in shown and "| tau 0 | touch |" in shown
    assert main([*words, "--set", "steps=1", "--tables-only"]) == 0
    assert "all runs are finished" in capsys.readouterr().out
    assert main([*words, "--set", "steps=1", "--tables-only", "--rows", "tau 0"]) == 0
    shown = capsys.readouterr().out
    assert "| tau 0 | touch |" in shown and "tau 1" not in shown


@pytest.fixture
def two_folds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A plan over 40 pairs of 8 objects: fold1 tests objects 0 to 3, fold2 the rest, in ``same`` fold1 again, and ``few``
    one of the rest."""
    monkeypatch.setenv("MVITAC_CACHE", str(tmp_path / "cache"))
    lines = ["vision,touch,label,object,fold1,fold2,same,few"]
    for i in range(40):
        thing = i % 8
        for name in ("v", "t"):
            picture(tmp_path / f"{name}{i}.png", 60 + 90 * (thing % 2) + i)
        first, second = ("test", "train") if thing < 4 else ("train", "test")
        few = "test" if thing == 7 else "train"
        lines.append(f"v{i}.png,t{i}.png,{'ab'[thing % 2]},{thing},{first},{second},{first},{few}")
    (tmp_path / "pairs.csv").write_text("\n".join(lines))
    (tmp_path / "plan.toml").write_text(
        f"""
        recipe = "smoke"
        seeds = 2
        modalities = ["both"]
        set = {{ steps = 2, eval_every = 0 }}
        data = {{ name = "folder", path = "{tmp_path / "pairs.csv"}", labels = ["label"], group = "object", size = 32 }}
        folds = ["split=fold1", "split=fold2"]
        [[rows]]
        label = "MViTac"
        [[rows]]
        label = "SimCLR"
        method = "simclr"
        """
    )
    return tmp_path / "plan.toml"


@pytest.mark.slow
def test_folds_are_run_apart_and_pooled(two_folds: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    main(["compare", "--plan", str(two_folds), "--out", str(out)])
    assert "2 rows x 2 seeds x 2 folds = 8 runs" in capsys.readouterr().out
    assert "2 folds: every test object is scored once" in (out / "table.md").read_text()
    result = json.loads((out / "result.json").read_text())
    keys = ("source", "seed", "task", "modality", "probe")
    assert len({tuple(r[k] for k in keys) for r in result["records"]}) == len(result["records"])
    one = next(r for r in result["records"] if (r["source"], r["seed"], r["modality"]) == ("SimCLR", 1, "both"))
    files = [out / fold / "runs/simclr/seed1/scores.json" for fold in ("fold1", "fold2")]
    apart = [next(r for r in json.loads(f.read_text())["records"] if r["modality"] == "both") for f in files]
    assert one["group_sizes"] == [5] * 8 and one["num_test"] == 40
    assert one["group_correct"] == apart[0]["group_correct"] + apart[1]["group_correct"]
    assert one["accuracy"] == pytest.approx((apart[0]["accuracy"] + apart[1]["accuracy"]) / 2)
    assert one["auroc"] == pytest.approx((apart[0]["auroc"] + apart[1]["auroc"]) / 2)
    recalls = [row[k] / sum(row) for k, row in enumerate(one["confusion"])]
    assert one["balanced_accuracy"] == pytest.approx(np.mean(recalls))
    (out / "fold2/runs/simclr/seed1/scores.json").unlink()
    (out / "fold2/runs/simclr/seed1/model.safetensors").unlink()
    main(["compare", "--plan", str(two_folds), "--out", str(out), "--tables-only"])
    assert "**Not finished: SimCLR, fold2, seed 1.**" in (out / "table.md").read_text()
    left = json.loads((out / "result.json").read_text())["records"]
    assert {r["seed"] for r in left if r["source"] == "SimCLR"} == {0}


@pytest.mark.parametrize(
    ("folds", "message"),
    [
        (["split=fold1", "split=same"], "folds 'fold1' and 'same' both test object '0'"),
        (["split=fold1", "split=Fold1"], "do not tell them apart"),
        (["splits=fold1"], "unknown field in run.data 'splits'"),
    ],
)
def test_folds_that_cannot_be(
    two_folds: Path, tmp_path: Path, folds: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["compare", "--plan", str(two_folds), "--folds", *folds, "--out", str(tmp_path / "out")]) == 2
    assert message in capsys.readouterr().err


def test_groups_are_tested_once_in_own_splits(two_folds: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plan = find_plan(str(two_folds))
    real = type(plan.data).open

    def with_own_split(self: DatasetConfig, *, quiet: bool = False) -> Pack:
        pack = real(self, quiet=quiet)
        spec = replace(pack.spec, tasks=(replace(pack.spec.tasks[0], split="mine"),))
        return with_columns(pack, spec=spec, mine=["train", "test"] * 20)

    monkeypatch.setattr(type(plan.data), "open", with_own_split)
    with pytest.raises(ValueError, match=r"both test object '1' \(column mine\): each group must be tested once"):
        lay_out_folds(plan, tmp_path / "out", ProbeConfig())


def test_a_row_that_one_fold_does_not_allow_runs_on_none(two_folds: Path, tmp_path: Path) -> None:
    plan = find_plan(str(two_folds))
    big = Row(label="big", set={"batch_size": 32})  # few has 35 rows to train on, fold1 has 20
    plan = replace(plan, rows=(*plan.rows, big), folds=("split=few", "split=fold1"))
    works = lay_out_folds(plan, tmp_path / "out", ProbeConfig())
    assert [sorted({job.label for job in work.jobs}) for work in works] == [["MViTac", "SimCLR"]] * 2
    assert all("20 rows to train on" in work.left_out["big"] for work in works)
