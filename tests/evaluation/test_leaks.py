"""What a run learned from, or its owner says so, is compared with what is scored: refused, or LEAK beside every score."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import safetensors.torch
from PIL import Image

import mvitac
from mvitac.bench.external import open_model
from mvitac.bench.external.adapters import said
from mvitac.cli.main import main
from mvitac.data.build import build
from mvitac.data.pack import Pack
from mvitac.data.row_hashes import image_sums, known_images, split_leaks
from mvitac.data.source import Sample
from mvitac.data.spec import Window
from mvitac.data.windows import windowed
from mvitac.datasets.folder import FolderConfig
from mvitac.datasets.pack import ON_VAL, PackConfig
from mvitac.deploy.publish import publish
from mvitac.evaluation import leaks
from mvitac.evaluation.evaluate import ProbeConfig, probe_runs, stored_result
from mvitac.evaluation.leaks import FILE, UNKNOWN, Scored, read_sources, source_of, write_sources
from mvitac.evaluation.score_text import with_interval
from mvitac.evaluation.scores import pool, summarise
from mvitac.nn.encoders import build_trunk
from mvitac.nn.initial import Init
from mvitac.report.report import write_report
from mvitac.report.tables import unseen_groups
from mvitac.system.files import read_json
from mvitac.training.loop import train
from support.forged_packs import refuse_pipe
from support.toy import Toy, altered, with_columns
from support.training_runs import smoke

ALL = "72 of 72 test rows and 36 of 36 test instances were trained on (toy)"


@pytest.fixture
def run(smoke_run: Path, tmp_path: Path) -> Path:
    return shutil.copytree(smoke_run, tmp_path / "run", ignore=shutil.ignore_patterns("probe.json"))


def test_leaked_scores_are_refused(run: Path, turned: Pack, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["probe", str(run), "--on", str(turned.path), "--json", str(tmp_path / "x.json")]) == 2
    error = capsys.readouterr().err
    assert ALL in error and "--allow-leak" in error and "'pattern'" in error and error.count("\n") == 1
    assert not (run / "probe.json").exists() and not (tmp_path / "x.json").exists()
    assert main(["publish", str(run), str(tmp_path / "art"), "--on", str(turned.path)]) == 2
    assert ALL in capsys.readouterr().err and not (tmp_path / "art").exists()


@pytest.mark.usefixtures("undrawn")
def test_leak_is_beside_all_scores(run: Path, turned: Pack, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """In the terminal, JSON, the report and the card; not beside controls, which learned nothing from those rows."""
    file = tmp_path / "x.json"
    assert main(["probe", str(run), "--on", str(turned.path), "--allow-leak", "--json", str(file)]) == 0
    shown = capsys.readouterr().out
    lines = [line for line in shown.splitlines() if "LEAK" in line and "LEAK:" not in line]
    # 2 tasks of 3 inputs, then 2 directions of retrieval at R@1, R@5 and R@10
    assert [line.count("LEAK") for line in lines] == [3, 3, 3, 3] and shown.count("LEAK: mvitac, ") == 3
    assert max(map(len, lines)) <= 80 and "untrained" in shown
    assert ALL in " ".join(shown.split()) and "retrieval over test instances" in shown and "unseen" not in shown
    result = read_json(file, "scores")
    for record in [*result["records"], *result["retrieval"]]:
        assert record.get("leak", "") == (ALL if record["source"] == "mvitac" else ""), record["source"]
    assert result["summary"]["pattern"]["touch"]["mvitac"]["leak"] == ALL
    assert "leak" not in result["summary"]["pattern"]["touch"]["untrained"]
    assert {r["leak"] for r in read_json(run / "probe.json", "scores")["records"] if "run" in r} == {ALL}
    page = write_report([run], tmp_path / "report", result=result, pack=turned, quiet=True).read_text()
    assert page.count(" LEAK") >= 4 + 6 + 6 and "scored on test instances" in page and "unseen" not in page
    card = (publish(run, tmp_path / "art", turned, allow_leak=True) / "README.md").read_text()
    lines = [line for line in card.splitlines() if line.startswith("| mvitac ")]
    assert [line.count(" LEAK |") for line in lines] == [3, 3]  # two tasks of three inputs
    assert ALL in " ".join(card.split()) and "neither encoders nor probes saw" not in card
    assert (tmp_path / "art" / FILE).read_bytes() == (run / FILE).read_bytes()


@pytest.mark.usefixtures("undrawn")
def test_a_forgotten_group_is_told_below_scores(pack: Pack, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = []
    for i, split in enumerate(pack.column("split")):
        names = {m: f"{m}{i:03d}.png" for m in ("vision", "touch")}
        for m, name in names.items():
            Image.fromarray(pack.images[m][i]).save(tmp_path / name)
        rows.append({**names, "split": split, "cup": f"cup {i % 9}", "kind": f"{pack.column('label_pattern')[i]}"})
    pq.write_table(pa.Table.from_pylist(rows), tmp_path / "m.parquet")
    made = ["--path", str(tmp_path / "m.parquet"), "--labels", "kind", "--size", "32", "--workers", "1", "--quiet"]
    assert main(["data", "pack", "--data", "folder", *made, "--out", str(tmp_path / "forgotten")]) == 0
    warning = "no --group was given, so every row is its own group"
    assert main(["data", "check", str(tmp_path / "forgotten"), "--json", str(tmp_path / "c.json")]) == 1
    found = [f for f in read_json(tmp_path / "c.json", "findings")["findings"] if f["item"] == "groups"]
    assert found[0]["verdict"] == "look" and warning in found[0]["evidence"] and "cup 9 of 9" in found[0]["evidence"]
    mvitac.train(smoke(Pack(tmp_path / "forgotten"), steps=1, eval_every=0), tmp_path / "run", quiet=True)
    capsys.readouterr()
    assert main(["probe", str(tmp_path / "run"), "--modalities", "touch"]) == 0
    assert f"note: {warning}" in " ".join(capsys.readouterr().out.split())
    assert warning in write_report([tmp_path / "run"], tmp_path / "report", quiet=True).read_text()
    assert warning in (publish(tmp_path / "run", tmp_path / "art") / "README.md").read_text()


def test_a_split_that_leaks_marks_every_score(run: Path, pack: Pack) -> None:
    own = with_columns(pack, split=np.where(np.arange(pack.num) % 2 == 0, "test", "train"))
    result = probe_runs([run], ProbeConfig(tasks=("pattern",), modalities=("touch",)), own, allow_leak=True)
    assert {leaks.leak_mark(record["leak"]) for record in (*result["records"], *result["retrieval"])} == {" LEAK"}
    assert "60 of 60 test instances are also in train: this split leaks" in result["leaks"]


def test_without_a_list_leaks_are_unknown(run: Path, turned: Pack) -> None:
    (run / FILE).unlink()
    result = probe_runs([run], ProbeConfig(tasks=("pattern",), modalities=("touch",), controls=False), turned)
    assert {r["leak"] for r in result["records"]} == {"unknown"} and "unknown" in result["leaks"][0]
    assert with_interval(0.5, 0.4, 0.6, "unknown") == "50.0 [40.0, 60.0] LEAK?"
    assert with_interval(-0.2, None, 0.9) == "-20.0 [-inf, 90.0]"  # R2 that is not known to any lower end
    assert with_interval(0.8, None, 1 - 1e-16) == with_interval(0.8, None, 0.99999) == "80.0"  # of two groups
    assert with_interval(0.5, None, 1.0) == "50.0"  # one test group: no interval


def test_groups_leak_where_no_row_does(pack: Pack) -> None:
    first, second = (pack.rows("train")[i::2] for i in range(2))
    num = len(np.unique(pack.column("group")[second]))
    leak = f"0 of {len(second)} test rows and {num} of {num} test instances were trained on (toy)"
    assert Scored(pack).leak([source_of(pack, first)], second) == leak


def test_every_source_of_a_run_counts(pack: Pack, tmp_path: Path) -> None:
    """A run may have several: its own rows, and those of a run whose weights it started from."""
    own, other = source_of(pack, pack.rows("train")), replace(source_of(pack, pack.rows("test")), name="before")
    write_sources(tmp_path, [own, other])
    read = read_sources(tmp_path)
    assert read and [source.name for source in read] == ["toy", "before"]
    leak = Scored(pack).leak(read, pack.rows("test"))
    assert leak.endswith("were trained on (before)") and "(toy)" not in leak
    assert leaks.leaks_of([{"source": "a", "task": "t", "leak": leak}] * 2) == [f"a, t: {leak}", leaks.NOT_SEEN]


def test_a_list_is_that_of_its_run_and_of_its_weights(pack: Pack, tmp_path: Path) -> None:
    val = pack.rows("val")
    train(replace(smoke(pack), steps=1), tmp_path, quiet=True)
    assert Scored(pack).leak(read_sources(tmp_path), val) == ""
    leak = f"{len(val)} of {len(val)} test rows and "
    assert (found := Scored(pack).leak(read_sources(tmp_path, "best"), val)).startswith(leak) and leaks.CHOSE in found
    start = Init(path=tmp_path / "model.best.safetensors")
    heir = train(replace(smoke(pack), steps=1, init=start), tmp_path / "heir", quiet=True)
    assert leaks.CHOSE in Scored(pack).leak(read_sources(heir), val)
    write_sources(tmp_path, [source_of(pack, pack.rows("test"))])  # of a run that saw other rows
    with pytest.raises(ValueError, match="is of another run"):
        read_sources(tmp_path)
    refuse_pipe(tmp_path / "trained_on.safetensors", lambda: read_sources(tmp_path))


def test_numbers_mean_nothing_outside_their_dataset(pack: Pack) -> None:
    """Ids of the striped pairs are numbers; those of its groups are names."""
    nameless = replace(source_of(pack, pack.rows("train")), images=np.zeros(0, np.uint64))
    leak = Scored(with_columns(pack, spec=replace(pack.spec, name="other"))).leak([nameless], pack.rows("train"))
    assert leak.startswith(f"0 of {len(pack.rows('train'))} test rows and ")
    again = with_columns(pack, spec=replace(pack.spec, name="toy (another split)"))
    assert Scored(again).leak([source_of(pack, pack.rows("train"))], pack.rows("train")).startswith("72 of 72 test")


@pytest.mark.parametrize("kept", ["both", "touch", "touch beside another photo"])
def test_the_same_images_under_other_names_leak(pack: Pack, tmp_path: Path, kept: str) -> None:
    """In another order, with other ids, every row its own group: each image counts, whatever it is paired with."""

    def other(_: Sample, item: int) -> dict[str, Any]:
        (sample,) = Toy().read(119 - item)
        photo = {"touch": None, "both": sample.vision}.get(kept, sample.vision[::-1])  # type: ignore[index]
        names = {"id": f"row {item}", "group": f"new {item}"}
        return {**sample.columns, **names, "vision": photo, "touch": sample.touch}

    source = altered(Toy(vision_channels=3 * (kept != "touch")), other, name="other")
    renamed = build(source, tmp_path / "renamed", size=32, quiet=True)
    write_sources(tmp_path, [source_of(pack, pack.rows("train"))])
    (read,) = read_sources(tmp_path) or ()
    assert len(read.images) == 2 * len(pack.rows("train"))
    for split, num in (("train", len(pack.rows("train"))), ("test", 0)):
        rows = renamed.rows(split)
        leak = Scored(renamed).leak([read], rows)
        assert leak.startswith(f"{num} of {len(rows)} test rows and 0 of") if num else leak == ""


def test_the_image_of_one_of_two_gels_is_a_leak(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    left, right, other = (rng.integers(0, 255, (4, 32, 32, 3), dtype=np.uint8) for _ in range(3))
    packs = {}
    for name, (one, two) in {"a": (left, right), "b": (other, left), "c": (other, other)}.items():
        for i, image in enumerate(np.concatenate([one, two], axis=3)):
            for side in range(2):
                Image.fromarray(image[..., 3 * side : 3 * side + 3]).save(tmp_path / f"{name}{side}{i}.png")
        lines = (f"{name}0{i}.png,{name}1{i}.png,{name}{i // 2},{i % 2}" for i in range(4))
        (tmp_path / f"{name}.csv").write_text("\n".join(["left,right,press,frame", *lines]))
        config = FolderConfig(path=tmp_path / f"{name}.csv", title=name, touch=("left", "right"), group="press")
        packs[name] = build(config.source(), tmp_path / name, size=32, quiet=True)
    seen = [source_of(packs["a"], np.arange(4))]
    for pack in (packs["b"], windowed(packs["b"], Window(frames=2))):
        assert Scored(pack).leak(seen, np.arange(4)).startswith("4 of 4 test rows and 0 of")
    assert Scored(packs["c"]).leak(seen, np.arange(4)) == ""
    halves = with_columns(packs["a"], split=["train", "test"] * 2)  # of each press
    assert split_leaks(halves, ())["split"].startswith("2 of 2 test presss are also in train")
    assert "and images of 2 of 2 test rows are" in split_leaks(windowed(halves, Window(frames=2)), ())["split"]
    first, second = [source_of(packs["a"], np.array([0]))], np.array([1])  # the second frame's window shows the first
    assert Scored(packs["b"]).leak(first, second) == ""
    assert Scored(windowed(packs["b"], Window(frames=2))).leak(first, second).startswith("1 of 1 test rows")
    alone = source_of(windowed(packs["a"], Window(frames=2)), second)  # which is trained on both
    assert Scored(packs["b"]).leak([alone], np.array([0])).startswith("1 of 1 test rows")


def test_equal_checksums_by_chance_are_no_leak(pack: Pack) -> None:
    """Of 100,000 and 100,000 different images, two or three have the same CRC-32."""
    rows, sums = pack.rows("train"), image_sums(pack)
    one = sums[rows[:1], 1]  # of touch
    assert (some := known_images(pack, rows, one)).sum() == 1 and some[0, 1]
    assert not known_images(pack, rows, np.concatenate([one, (1 << 33) + np.arange(1 << 18, dtype=np.uint64)])).any()


def test_data_changed_since_training_is_said(pack: Pack, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    place = Path(shutil.copytree(pack.path, tmp_path / "pack"))
    run, asked = train(smoke(Pack(place), steps=1), tmp_path / "run", quiet=True), ProbeConfig(controls=False)
    again = ["pretrain", "--from", str(run / "run.json"), "--quiet", "--out"]
    assert not probe_runs([run], asked)["notes"] and main([*again, str(tmp_path / "a")]) == 0
    assert "warning" not in capsys.readouterr().err
    shutil.rmtree(place)
    build(Toy(num=96), place, size=pack.size, quiet=True)
    (note,) = probe_runs([run], asked)["notes"]
    assert "changed since training" in note
    assert note in (publish(run, tmp_path / "artifact") / "README.md").read_text()
    assert main([*again, str(tmp_path / "b")]) == 0 and "its data is not that of" in capsys.readouterr().err
    assert main(["export", str(run), "--out", str(tmp_path / "x")]) == 0
    assert "was trained on other data than its probes are fitted on" in capsys.readouterr().err


def test_an_export_checked_on_rows_that_its_run_has_seen_says_so(
    smoke_run: Path, pack: Pack, turned: Pack, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    said = []
    for checked in (pack, turned):
        options = ["--on", str(checked.path), "--out", str(tmp_path / checked.path.parent.name)]
        assert main(["export", str(smoke_run), "--modalities", "touch", *options]) == 0
        said.append(capsys.readouterr().out)
    assert "LEAK" not in said[0] and "LEAK: 72 of 72 test rows" in said[1]


def test_scores_on_val_are_not_taken_for_those_on_test(pack: Pack, tmp_path: Path) -> None:
    """Both are of one pack, so its digest does not tell them apart: the note does."""
    data = PackConfig(path=pack.path, score_on="val")
    mvitac.train(replace(smoke(pack, steps=1, eval_every=0), data=data), tmp_path / "run", quiet=True)
    scores = probe_runs([tmp_path / "run"], ProbeConfig())
    assert ON_VAL in scores["notes"] and ON_VAL in " ".join(str(scores).split())
    assert stored_result([tmp_path / "run"], data.open()) is not None
    assert stored_result([tmp_path / "run"], pack) is None
    for text in ("[]", "{}"):
        (tmp_path / "run" / "probe.json").write_text(text)
        assert stored_result([tmp_path / "run"], data.open()) is None


def test_numbers_of_rows_are_no_groups(pack: Pack) -> None:
    """Of two tables with ids, whose rows are their own groups, rows with one number are not the same."""
    other = with_columns(pack, spec=replace(pack.spec, group_by="row"))
    scored, rows = Scored(other), pack.rows("train")
    learned = source_of(other, rows)
    assert scored.leak([replace(learned, ids=np.ones(1, np.uint64), images=np.zeros(0, np.uint64))], rows) == ""
    assert scored.leak([learned], rows) == "72 of 72 test rows were trained on (toy)"


def test_summaries_and_folds_keep_the_leak() -> None:
    record = {"source": "a", "seed": 0, "task": "t", "modality": "touch", "probe": "linear", "num_test": 2}
    record |= {"group_sizes": [1, 1], "group_correct": [1, 0], "confusion": [[1, 0], [1, 0]], "class_groups": [1, 1]}
    record |= {"balanced_accuracy": None, "macro_f1": None, "auroc": None}
    (pooled,) = pool([[{**record, "leak": ""}], [{**record, "leak": "seen"}]])
    assert pooled["leak"] == "seen" and "leak" not in pool([[record], [record]])[0]
    assert summarise([pooled])["t"]["touch"]["a"]["leak"] == "seen"
    assert unseen_groups("object", [pooled]) == "test objects" and unseen_groups("object", [record]) == "unseen objects"


def test_python_scores_as_the_command_does(run: Path, turned: Pack) -> None:
    scores = mvitac.probe(run, tasks=("pattern",), modalities=("touch",))
    assert read_json(run / "probe.json", "a probe result")["summary"] == json.loads(json.dumps(scores["summary"]))
    with pytest.raises(ValueError, match="allow-leak"):
        mvitac.probe(run, on=turned)
    assert f"retrieval: {ALL}" in " ".join(mvitac.probe(run, on=turned, allow_leak=True, controls=False)["leaks"])


SAID = [
    ("ImageNet-1k", ""),
    ("ImageNet-1k; Toy", "toy was in its owner's training, which rows is not known"),
    ("ToyImages", "toy was in its owner's training, which rows is not known"),
    ("web stories", ""),
    ("", UNKNOWN),
    (" ", UNKNOWN),
    ("Unknown", UNKNOWN),
    ("ImageNet-1k; unknown", UNKNOWN),
]


def weights(pack: Pack, folder: Path, text: str) -> Path:
    trunk = build_trunk(smoke(pack).encoder.touch, 3)
    header = {"trained_on": text} if text else None
    safetensors.torch.save_file(trunk.state_dict(), folder / "theirs.safetensors", metadata=header)
    return folder / "theirs.safetensors"


@pytest.mark.parametrize(("text", "leak"), SAID)
def test_start_weights_of_which_their_owner_says_it(
    text: str, leak: str, pack: Pack, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = weights(pack, tmp_path, text)
    run = smoke(pack)
    run = replace(run, encoder=run.encoder.changed(weights=str(file)), steps=1)
    train(run, tmp_path / "run", quiet=True)
    told = capsys.readouterr().err
    unknown = f"mvitac: warning: nothing says what {file} was trained on: leaks of test rows cannot be excluded"
    assert told.startswith(unknown) == (leak == UNKNOWN) and (leak in told or leak == UNKNOWN)
    own, theirs = read_sources(tmp_path / "run") or []
    assert own.name == "toy" and theirs.name == (f"{leaks.DECLARED}{text}" if text else "theirs.safetensors")
    assert Scored(pack).leak([theirs], pack.rows("test")) == leak
    assert [leaks.file_source(file).name for file in leaks.weights_files(run)] == [theirs.name]
    assert not leaks.weights_files(smoke(pack))
    assert open_model(f"external:timm/{run.encoder.touch.trunk},weights={file},size=32").trained_on == (text or UNKNOWN)


def test_other_names_of_the_data_count_too(pack: Pack, tmp_path: Path) -> None:
    source = leaks.file_source(weights(pack, tmp_path, "Touch and Go"))
    scored, rows = Scored(pack), pack.rows("test")
    assert scored.leak([source], rows) == "" and "TAG, Touch-and-Go" not in scored.leak([source], rows)
    assert scored.leak([source], rows, ["TAG", "touch-and-go"]).startswith("touch-and-go was in its owner's training")
    assert scored.leak([source], rows, ["hand", "own"]) == ""  # parts of words


def test_what_timm_says_of_its_weights() -> None:
    tags = ("augreg_in21k_ft_in1k", "mystery", "")
    assert [said(tag) for tag in tags] == ["timm's augreg_in21k_ft_in1k", UNKNOWN, UNKNOWN]
