"""The report: its numbers are the probe's, its marks are true, it asks nothing of the network, it bears odd input."""

import contextlib
import io
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from html import unescape
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mvitac.cli.main import main
from mvitac.data.build import build
from mvitac.data.pack import Pack
from mvitac.data.source import Sample, Source
from mvitac.data.spec import DataSpec, Task
from mvitac.datasets.simulated import MaterialsConfig
from mvitac.deploy.publish import publish
from mvitac.evaluation.evaluate import ProbeConfig, probe_runs, stored_result
from mvitac.evaluation.intervals import interval
from mvitac.evaluation.score_text import cell_text, columns_of, verdicts
from mvitac.evaluation.scores import summarise
from mvitac.experiments.table import lines_of
from mvitac.experiments.table_formats import latex, markdown
from mvitac.methods.supervised import SupervisedConfig
from mvitac.report import figures
from mvitac.report.galleries import nearest_rows
from mvitac.report.report import write_report
from mvitac.report.tables import retrieval_rows
from mvitac.run import Run
from mvitac.system.files import read_json, write_json
from mvitac.training.loop import train
from support import training_runs
from support.pages import drawings
from support.small_plans import compared


class Page(HTMLParser):
    """Tags, attributes and text of a page, as a browser would take it apart."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.skip = False
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        self.skip = tag == "style"
        self.text += f"{dict(attrs).get('alt') or ''}\n"

    def handle_data(self, data: str) -> None:
        self.text += "" if self.skip else data + "\n"

    def all(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.tags if name == tag]

    def images(self, kind: str) -> list[dict[str, str | None]]:
        return [image for image in self.all("img") if (image["src"] or "").startswith(f"data:image/{kind};")]


HOSTILE = '<script>alert("1")</script> & $x_1$'


@dataclass(frozen=True)
class Noise(Source):
    """Random pictures: thirty-six groups of two rows, every third group test, all with hostile names."""

    vision: int = 3
    touch: int = 3
    labelled: bool = True
    tested: tuple[int, ...] = tuple(range(2, 36, 3))
    name: str = "noise"

    def spec(self) -> DataSpec:
        tasks = (Task(name="kind", classes=(HOSTILE, "b")),) if self.labelled else ()
        channels: dict[str, Any] = {"vision_channels": self.vision, "touch_channels": self.touch}
        return DataSpec(name=self.name, **channels, tasks=tasks, group_by="thing", licence="none", source=HOSTILE)

    def items(self) -> Sequence[str]:
        return [str(i) for i in range(72)]

    def read(self, item: int) -> list[Sample]:
        rng, group = np.random.default_rng(item), item // 2
        columns = {"id": str(item), "group": f"{group}{HOSTILE}", "split": "test" if group in self.tested else "train"}
        labels = {"label_kind": group % 2} if self.labelled else {}
        shown = [rng.integers(0, 256, (16, 16, c), np.uint8) if c else None for c in (self.vision, self.touch)]
        return [Sample(vision=shown[0], touch=shown[1], columns={**columns, **labels})]

    def fingerprint(self) -> dict[str, Any]:
        return {"noise": [self.vision, self.touch, self.labelled, self.tested]}


def smoke(pack: Pack, **changes: Any) -> Run:
    run = training_runs.smoke(pack, batch_size=8, steps=2, log_every=1, **changes)
    return replace(run, augment=replace(run.augment, size=16))


@pytest.fixture(scope="session")
def materials(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a simulated pack, two seeds trained on it, what their probe found, their report."""
    folder = tmp_path_factory.mktemp("materials")
    pack = build(MaterialsConfig(num=120, touches=1, size=16).source(), folder / "pack", size=16, quiet=True)
    runs = [train(smoke(pack, seed=seed), folder / f"run{seed}", quiet=True) for seed in (0, 1)]
    assert main(["probe", *map(str, runs), "--json", str(folder / "probe.json")]) == 0
    with contextlib.redirect_stdout(io.StringIO()) as said:
        assert main(["report", *map(str, runs), "--out", str(folder / "out")]) == 0
    assert f"scores: {runs[0] / 'probe.json'}" in said.getvalue()
    return folder


@pytest.fixture(scope="session")
def result(materials: Path) -> dict[str, Any]:
    return read_json(materials / "probe.json", "scores")


def noise(tmp_path: Path, source: Noise, **changes: Any) -> tuple[Path, Pack]:
    pack = build(source, tmp_path / "pack", size=16, quiet=True)
    return train(smoke(pack, **changes), tmp_path / "run", quiet=True), pack


def test_shows_every_score_of_the_probe(materials: Path, result: dict[str, Any]) -> None:
    html = (materials / "out" / "report.html").read_text()
    shown: dict[tuple[str, str], list[str]] = {}
    for body in re.findall(r'aria-label="(?:accuracy|R2)">.*?<tbody>(.*?)</tbody>', html, re.DOTALL):
        task = ""
        for row in filter(None, (re.findall(r">([^<]*)</t[hd]>", row) for row in body.split("</tr>"))):
            task = row[0].split(" (")[0] if len(row) == 1 else task  # category (24 test instances)
            shown[task, row[0]] = [unescape(value).replace("\xa0", " ").replace("\u2011", "-") for value in row[1:]]
    assert set(result["summary"]) == {"category", "soft", "rough", "force"}
    for task, found in result["summary"].items():
        sources = {source for cells in found.values() for source in cells}
        controls = {"imagenet", "untrained", "pixels", "border", "mean" if task == "force" else "majority"}
        assert sources == {"mvitac", *controls}
        for source in sources:
            assert shown[task, source] == [cell_text(found, source, m) for m in columns_of(found)]


def test_verdict_and_figures_carry_the_numbers_and_nothing_is_asked_of_the_network(
    materials: Path, result: dict[str, Any]
) -> None:
    page = Page((materials / "out" / "report.html").read_text())
    drawn = {path.name for path in (materials / "out" / "figures").iterdir()}
    assert {"probe-category.png", "loss.png", "confusion-soft.png"} <= drawn
    assert len(page.images("svg+xml")) == len(drawn) and "Every class of category, by touch + vision" in page.text
    assert verdicts(result["summary"]["category"])[0].partition(": ")[2] in page.text.replace("\xa0", " ")
    for curve in ("parts of the loss", "effective rank", "linear probe, rough", "retrieval R@5"):
        assert curve in page.text
    assert "default-src 'none'; img-src data:" in str(page.all("meta"))
    assert not {"script", "link", "iframe", "object", "embed", "form"} & {tag for tag, _ in page.tags}
    for _, attributes in page.tags:
        for name in ("src", "href", "srcset", "data"):
            allowed = ("#", "data:image/jpeg;base64,", "data:image/svg+xml;base64,")
            assert (attributes.get(name) or "#").startswith(allowed)
    assert all(image["alt"] for image in page.all("img"))
    ids = [a["id"] for _, a in page.tags if "id" in a]
    assert len(ids) == len(set(ids)) and {a["href"] for a in page.all("a")} == {f"#{id_}" for id_ in ids}


def test_a_mistake_is_nearest_to_another_class_by_touch_alone(tmp_path: Path) -> None:
    values = np.array([[1.0, 0.0], [0.9, 0.1], [5.0, 1.0], [0.0, 2.0]])  # lengths do not matter
    near = nearest_rows(values, np.array(["a", "a", "b", "c"]), 2)
    assert near.tolist() == [[2, 3], [2, 3], [1, 3], [2, 1]]  # one of each other group
    run, _ = noise(tmp_path, Noise(vision=0))
    html = write_report([run], tmp_path / "out", quiet=True).read_text()
    assert "Not scored: it takes a space that both modalities share" in html
    assert "mvitac by touch: interval" in html.replace("\xa0", " ")
    html = html[html.index('<h2 id="mistakes">') :]
    strips = html.split('<div class="query">')[1:]
    assert 2 <= len(strips) <= 16 and re.search(r"touch: \d+ of 24 rows", html)
    for strip in strips:
        marks = re.findall(r'<div class="(same|wrong)">', strip)
        assert len(marks) == 5 and marks[0] == "wrong"
        own, *found = re.findall(r"<span>(.*?)[;<]", strip)
        assert [mark == "same" for mark in marks] == [name == own for name in found]


def test_hostile_names_stay_text(tmp_path: Path) -> None:
    run, _ = noise(tmp_path / "<script>x&", Noise(touch=6))
    page = Page(write_report([run], tmp_path / "out", quiet=True).read_text())
    assert not page.all("script") and HOSTILE in page.text  # the data's source
    assert page.text.count(HOSTILE[:15]) > 16  # the class name, in figures and below pictures
    assert any(HOSTILE in (image["alt"] or "") for image in page.all("img"))
    assert {int(image["width"] or 0) for image in page.images("jpeg")} == {16, 32}  # two gels stand side by side


@pytest.mark.usefixtures("undrawn")
def test_without_labels(tmp_path: Path) -> None:
    run, _ = noise(tmp_path, Noise(labelled=False))
    page = Page(write_report([run], tmp_path / "out", quiet=True).read_text())
    assert "Scores of the frozen features" not in page.text
    assert "Nothing is scored on this data" in page.text and "Given one image, find its thing" in page.text
    assert len(page.images("jpeg")) == 2 * 8 * 6  # eight rows with five others, of each sense


@pytest.mark.usefixtures("undrawn")
def test_method_without_shared_space_beside_one_with(tmp_path: Path) -> None:
    first, pack = noise(tmp_path, Noise(), method=SupervisedConfig())
    second = train(smoke(pack), tmp_path / "second", quiet=True)
    (first / "log.jsonl").unlink()
    result = probe_runs([first, second], ProbeConfig(probes=("knn", "linear"), controls=False))
    page = Page(write_report([first, second], tmp_path / "out", result=result, quiet=True).read_text())
    for text in ("supervised, mvitac on noise", "The same by logistic regression", "parts of the loss, mvitac"):
        assert text in page.text
    linear, nearest = (summarise(result["records"], kind)["kind"]["both"] for kind in ("linear", "knn"))
    for cells in (linear, nearest):
        assert cell_text({"both": cells}, "mvitac", "both") in page.text.replace("\xa0", " ")
    assert "The runs left no log lines." in Page(write_report([first], tmp_path / "alone", quiet=True).read_text()).text


def test_bars_carry_leaks_and_lines_spare_the_names() -> None:
    cell = {"mean": 0.5, "low": 0.4, "high": 0.6, "leak": "3 of 4"}
    bars = figures.bars("x", {"touch": {"a": cell}}, {"majority": 0.1}, "%").axes[0]
    assert "50.0 LEAK" in [text.get_text() for text in bars.texts]
    dashed = [line for line in bars.lines if line.get_linestyle() == "--"]
    assert len(dashed) == 1 and min(dashed[0].get_ydata()) > 0  # below the group's name at y = 0


def test_retrieval_has_one_number_for_one_thing() -> None:
    """R@5 of the table is the mean of its interval, also where float32 would round to another tenth."""
    recalls = {"R@1": 0.1, "R@5": float(np.float32(3 / 2000)), "R@10": 0.1, "chance R@5": 0.1}
    record = {"source": "a", "direction": "x", **recalls, "group_sizes": [2000], "group_correct": [3], "seed": 0}
    mean = interval([record])[0]
    assert retrieval_rows([record])[0][3] == f"{100 * mean:.1f}"
    assert f"{100 * record['R@5']:.1f}" != f"{100 * mean:.1f}"  # what this is about


def texts_of(records: Sequence[dict[str, Any]]) -> dict[tuple[str, ...], str]:
    cells: dict[tuple[str, ...], list[dict[str, Any]]] = {}
    for r in (r for r in records if "group_correct" in r):  # of tasks with classes
        cells.setdefault((r["task"], r["modality"], r["source"]), []).append(r)
    assert len(cells) == 3 * (4 * 3 + 1 + 1)
    found = {cell: [100 * value for value in interval(records)] for cell, records in cells.items()}
    return {cell: f"{mean:.1f} [{low:.1f}, {high:.1f}]" for cell, (mean, low, high) in found.items()}


def test_report_and_comparison_give_one_text_for_one_score(materials: Path, result: dict[str, Any]) -> None:
    whole, html = compared(result), (materials / "out" / "report.html").read_text()
    page, drawn, lines = Page(html).text, "".join(drawings(html)), lines_of(whole)
    shown = page.replace("\xa0", " "), markdown(whole, lines), latex(whole, lines)
    for cell, text in texts_of(result["records"]).items():
        assert all(text in each for each in shown), cell
        assert re.search(rf"[> ]{re.escape(text.split()[0])}<", drawn), cell  # beside a bar or a line


def test_probe_and_card_give_one_text(materials: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run, card = materials / "run0", tmp_path / "card"
    assert main(["probe", str(run), "--json", str(tmp_path / "probe.json")]) == 0
    printed = capsys.readouterr().out
    assert main(["publish", str(run), str(card)]) == 0
    shown = (printed, capsys.readouterr().out, (card / "README.md").read_text())
    (run / "probe.json").unlink()
    assert (publish(run, tmp_path / "again") / "README.md").read_text() == shown[2]  # with controls of its own
    for cell, text in texts_of(json.loads((tmp_path / "probe.json").read_text())["records"]).items():
        assert all(text in each for each in shown), cell


@pytest.mark.usefixtures("undrawn")
def test_one_test_group_proves_nothing(tmp_path: Path) -> None:
    run, _ = noise(tmp_path, Noise(tested=(2,)))
    page = Page(write_report([run], tmp_path / "out", quiet=True).read_text())
    assert "11 test things with both." in page.text
    assert "1 test thing, so no interval" in page.text and "% [0.0, 100.0]" in page.text
    card = (publish(run, tmp_path / "card") / "README.md").read_text()
    few, _ = noise(tmp_path / "few", Noise(tested=(2, 5)))
    assert main(["publish", str(few), str(tmp_path / "few/card")]) == 0  # it prints no hint of probe's
    assert "(1 test thing, so no interval)" in card and re.search(r"\| untrained \| \S+ \[0\.0, 100\.0\] \|", card)


def test_only_a_complete_result_of_the_same_weights_is_used_again(
    materials: Path, result: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    runs, pack = [materials / "run0", materials / "run1"], Pack(materials / "pack")
    write_json(file := runs[0] / "probe.json", result)
    assert stored_result(runs, pack) == result
    assert stored_result(runs[::-1], pack) == result and stored_result(runs[:1], pack) is None
    asked = result["asked"]
    others: list[dict[str, Any]] = [{"controls": False}, {"tasks": ["soft"]}, {"probes": ["knn"]}]
    changes = [{"models": ["0" * 64, result["models"][0]]}, {"pack": "0" * 64}, {"records": "damaged"}]
    for change in (*({"asked": {**asked, **other}} for other in others), *changes):
        write_json(file, {**result, **change})
        assert stored_result(runs, pack) is None
    write_json(file, result, sealed=True)
    file.write_text(file.read_text().replace('"seed": 0', '"seed": 1', 1))
    assert stored_result(runs, pack) is None and "probe.json does not match its digest" in capsys.readouterr().err


def test_scores_of_other_runs_or_data_are_refused(materials: Path, result: dict[str, Any], tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="other data"):
        write_report([materials / "run0"], tmp_path, result={**result, "pack": "other"}, quiet=True)
    other = train(smoke(Pack(materials / "pack"), seed=7), tmp_path / "other", quiet=True)
    with pytest.raises(ValueError, match=r"differ in .*other"):
        write_report([other], tmp_path, result=result, quiet=True)
    with pytest.raises(ValueError, match=r"differ in .*run1"):
        write_report([materials / "run0"], tmp_path, result=result, quiet=True)
    (tmp_path / "report.html").write_text("my thesis")
    with pytest.raises(ValueError, match=r"report\.html is no report: choose another --out"):
        write_report([other], tmp_path, quiet=True)
