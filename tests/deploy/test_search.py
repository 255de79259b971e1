"""Search is exact, whatever the block; what is indexed is what the model gives; both directions find their pair."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from PIL import Image

import mvitac
from mvitac.cli.main import main
from mvitac.data.images import fit
from mvitac.data.pack import Pack
from mvitac.deploy.search import Index, build, nearest
from mvitac.model import Model
from support.examples import load_example


def unit(rng: np.random.Generator, *shape: int) -> np.ndarray:
    x = rng.normal(size=shape).astype(np.float32)
    return x / np.linalg.norm(x, axis=-1, keepdims=True)


@pytest.fixture(scope="module")
def index(artifact: Path, pack: Pack, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("index") / "index"
    assert main(["index", str(pack.path), "--model", str(artifact), "--out", str(out)]) == 0
    return out


@pytest.mark.parametrize("block", [1, 7, 100, 1000, 5000])
def test_search_is_exact_whatever_the_block(block: int) -> None:
    rng = np.random.default_rng(0)
    bank, queries = unit(rng, 1000, 16), unit(rng, 9, 16)
    rows, scores = nearest(bank, queries, 12, block=block)
    every = queries @ bank.T
    assert np.array_equal(rows, np.argsort(-every, axis=1, kind="stable")[:, :12])
    np.testing.assert_allclose(scores, -np.sort(-every, axis=1)[:, :12], atol=1e-6)


@pytest.mark.parametrize("block", [3, 64, 500])
def test_equal_rows_come_in_row_order(block: int) -> None:
    bank = np.repeat(np.eye(4, dtype=np.float32), 50, axis=0)
    rows, scores = nearest(bank, np.eye(4, dtype=np.float32)[[2, 0]], 60, block=block)
    assert np.array_equal(rows[0], [*range(100, 150), *range(10)])
    assert np.array_equal(rows[1], [*range(50), *range(50, 60)])
    assert (scores[:, :50] == 1).all() and (scores[:, 50:] == 0).all()


def test_equals_scikit_learn() -> None:
    from sklearn.neighbors import NearestNeighbors

    rng = np.random.default_rng(1)
    bank, queries = unit(rng, 3000, 32), unit(rng, 20, 32)
    expected = NearestNeighbors(n_neighbors=5, algorithm="brute", metric="cosine").fit(bank).kneighbors(queries)[1]
    assert np.array_equal(nearest(bank, queries, 5, block=512)[0], expected)


def test_impossible_searches_are_named() -> None:
    bank = np.eye(4, dtype=np.float32)
    with pytest.raises(ValueError, match="holds 4 dimensions"):
        nearest(bank, np.ones((1, 5), np.float32), 1)
    with pytest.raises(ValueError, match="give at least 1"):
        nearest(bank, bank, 0)
    assert nearest(bank, bank, 9)[0].shape == (4, 4)  # no more than there are


def test_a_row_finds_itself_and_both_directions_work(index: Path, pack: Pack, artifact: Path) -> None:
    opened = Index(index)
    model = opened.model()
    for modality in ("vision", "touch"):
        rows, scores = opened.find(model, pack.images[modality][[5, 77]], modality, modality, 3)
        assert rows[:, 0].tolist() == [5, 77]
        np.testing.assert_allclose(scores[:, 0], 1, atol=1e-4)
    both = mvitac.load(artifact).embed(vision=pack.images["vision"], touch=pack.images["touch"][:4], shared=True)
    expected = np.argsort(-(both["touch"] @ both["vision"].T).numpy(), axis=1, kind="stable")[:, :3]
    assert np.array_equal(opened.find(model, pack.images["touch"][:4], "touch", "vision", 3)[0], expected)
    assert opened.labels(0)["pattern"] == pack.spec.tasks[0].classes[pack.column("label_pattern")[0]]


def test_find_command_draws_what_it_found(
    index: Path, pack: Pack, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Image.fromarray(pack.images["touch"][11]).save(tmp_path / "q.png")
    command = ["find", str(tmp_path / "q.png"), "--in", str(index), "--to", "touch", "--k", "3"]
    assert main([*command, "--picture", str(tmp_path / "found.png")]) == 0
    shown = capsys.readouterr().out
    assert "1.000" in shown and pack.column("id")[11] in shown
    with Image.open(tmp_path / "found.png") as sheet:
        pixels = np.asarray(sheet)
    asked = fit(pack.images["touch"][11], 160)
    corners = np.argwhere((pixels[:-159, :-159] == asked[0, 0]).all(2))
    there = [(pixels[y : y + 160, x : x + 160] == asked).all() for y, x in corners]
    assert sum(there) == 2  # the query, and the row that it is
    assert pixels.shape[1] < 4 * 180 and pixels.shape[0] > 160 + 2 * 17  # one line, with captions
    (tmp_path / "bad.png").write_text("no picture")
    assert main(["find", str(tmp_path / "bad.png"), "--in", str(index)]) == 2
    assert "cannot be read as an image" in capsys.readouterr().err
    assert main(["find", "--in", str(index)]) == 2
    assert "name the picture to search for" in capsys.readouterr().err


def test_find_subtracts_the_background(
    index: Path, pack: Pack, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A touch that minus its background is row 11 finds row 11 when both files are given."""
    row = pack.images["touch"][11].astype(int)
    free = np.where(row < 128, 255, 0).astype(np.uint8)  # so that 2 (row - 128) + free fits into a byte
    raw = 2 * (row - 128) + free
    Image.fromarray(raw.astype(np.uint8)).save(tmp_path / "raw.png")
    Image.fromarray(free).save(tmp_path / "free.png")
    command = ["find", str(tmp_path / "raw.png"), "--in", str(index), "--to", "touch", "--k", "1"]
    background = ["--background", str(tmp_path / "free.png")]
    assert main([*command, *background]) == 2
    assert "was not trained on difference images" in capsys.readouterr().err
    plain = Index.model

    def model(self: Index) -> Model:
        found = plain(self)
        found.spec = replace(found.spec, difference=True)
        return found

    monkeypatch.setattr(Index, "model", model)
    assert main([*command, *background]) == 0
    shown = capsys.readouterr().out
    assert "1.000" in shown and pack.column("id")[11] in shown
    assert main(command) == 0
    assert "1.000" not in capsys.readouterr().out


def test_embed_command_writes_both_formats(artifact: Path, pack: Pack, tmp_path: Path) -> None:
    for name in ("x.npz", "x.parquet"):
        assert main(["embed", str(pack.path), "--model", str(artifact), "--out", str(tmp_path / name)]) == 0
    expected = mvitac.load(artifact).embed(touch=pack.images["touch"])["touch"].numpy()
    arrays = np.load(tmp_path / "x.npz", allow_pickle=False)
    table = pq.read_table(tmp_path / "x.parquet")
    assert arrays["id"].tolist() == table.column("id").to_pylist() == pack.column("id").tolist()
    np.testing.assert_allclose(arrays["touch"], expected, atol=1e-4)
    np.testing.assert_array_equal(np.stack(table.column("touch").to_numpy()), arrays["touch"])
    assert main(["embed", str(pack.path), "--model", str(artifact), "--out", str(tmp_path / "x.csv")]) == 2


def test_a_changed_index_is_refused(index: Path, tmp_path: Path, artifact: Path, pack: Pack) -> None:
    import shutil

    for name in ("touch.npy", "index.json"):
        copy = shutil.copytree(index, tmp_path / name)
        data = bytearray((copy / name).read_bytes())
        data[-10] ^= 1
        (copy / name).write_bytes(data)
        with pytest.raises(ValueError, match=r"does not match its digest|not valid JSON"):
            Index(copy)
    with pytest.raises(ValueError, match="already exists"):
        build(mvitac.load(artifact), pack, index)


def test_without_a_shared_space_only_like_finds_like(pack: Pack, tmp_path: Path, artifact: Path) -> None:
    from torch import nn

    model = mvitac.load(artifact)
    model.projectors = nn.ModuleDict()
    index = build(model, pack, tmp_path / "index", ("test",))
    assert index.meta["space"] == "features" and index.meta["num"] == len(pack.rows("test"))
    row = int(pack.rows("test")[3])
    assert index.find(model, pack.images["touch"][row], "touch", "touch", 1)[0].tolist() == [[3]]
    with pytest.raises(ValueError, match="no space that vision and touch share"):
        index.find(model, pack.images["touch"][row], "touch", "vision", 1)


@pytest.mark.parametrize("engine", ["scikit-learn", "faiss", "usearch"])
def test_the_benchmark_compares_equal_answers(engine: str) -> None:
    """Every engine beside ours is exact, and gets the same question."""
    search = load_example("search", "benchmarks")
    if engine not in search.installed():
        pytest.skip(f"{engine} is not installed")
    rng = np.random.default_rng(4)
    bank, queries = unit(rng, 500, 16), unit(rng, 7, 16)
    expected = search.searcher("mvitac", bank, 5, 1)(queries)
    found = search.searcher(engine, bank, 5, 1)
    assert np.array_equal(found(queries), expected) and np.array_equal(found(queries[:1]), expected[:1])


def test_the_benchmark_leaves_out_what_is_not_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    search = load_example("search", "benchmarks")
    monkeypatch.setitem(search.ENGINES, "faiss", "no_such_module")
    assert search.installed()[:2] == ["mvitac", "scikit-learn"] and "faiss" not in search.installed()
