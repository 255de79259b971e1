"""Search is exact and finds pairs in both directions."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from PIL import Image
from sklearn.neighbors import NearestNeighbors

from mvitac.cli.main import main
from mvitac.data.images import fit
from mvitac.data.pack import Pack
from mvitac.deploy.search import Embeddings, embed, nearest, unit
from mvitac.model import Model
from support.toy import toy_pack


@pytest.fixture(scope="module")
def known(artifact: Path, pack: Pack, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("known") / "known.parquet"
    assert main(["embed", str(pack.path), "--model", str(artifact), "--out", str(out), "--shared"]) == 0
    return out


def test_equals_scikit_learn() -> None:
    rng = np.random.default_rng(1)
    bank, queries = (unit(rng.normal(size=(num, 32)).astype(np.float32)) for num in (3000, 20))
    by = NearestNeighbors(n_neighbors=5, algorithm="brute", metric="cosine").fit(bank)
    distances, expected = by.kneighbors(queries)
    rows, cosines = nearest(bank, queries, 5)
    assert np.array_equal(rows, expected)
    np.testing.assert_allclose(cosines, 1 - distances, atol=1e-6)


def test_equal_rows_come_in_row_order_and_missing_ones_are_left_out() -> None:
    bank = np.repeat(np.eye(3, dtype=np.float32), 2, axis=0)
    bank[3] = np.nan
    rows, cosines = nearest(bank, np.eye(3, dtype=np.float32)[[2, 1]], 9)  # no more than there are
    assert rows.tolist() == [[4, 5, 0, 1, 2], [2, 0, 1, 4, 5]] and cosines[0].tolist() == [1, 1, 0, 0, 0]


def test_a_row_finds_itself_and_both_directions_work(known: Path, pack: Pack, model: Model) -> None:
    opened = Embeddings(known, model.weights_digest())
    for modality in ("vision", "touch"):
        rows, cosines = opened.find(model, pack.images[modality][[5, 77]], modality, modality, 3)
        assert rows[:, 0].tolist() == [5, 77]
        np.testing.assert_allclose(cosines[:, 0], 1, atol=1e-4)
    both = model.embed(vision=pack.images["vision"], touch=pack.images["touch"][:4], shared=True)
    expected = np.argsort(-(both["touch"] @ both["vision"].T).numpy(), axis=1, kind="stable")[:, :3]
    assert np.array_equal(opened.find(model, pack.images["touch"][:4], "touch", "vision", 3)[0], expected)
    assert opened.labels(0)["pattern"] == pack.spec.tasks[0].classes[pack.column("label_pattern")[0]]


def test_rows_of_another_size_than_a_query_has_are_refused(tmp_path: Path, model: Model) -> None:
    with pytest.raises(ValueError, match="has images of 24 px: pack it again with --size 32"):
        embed(model, toy_pack(tmp_path / "small", size=24), tmp_path / "e.parquet")


def test_find_command_draws_what_it_found(
    known: Path, artifact: Path, pack: Pack, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Image.fromarray(pack.images["touch"][11]).save(tmp_path / "q.png")
    of = ["--model", str(artifact), "--known", str(known)]
    command = ["find", str(tmp_path / "q.png"), *of, "--to", "touch", "--num", "3", "--json", str(tmp_path / "f.json")]
    assert main([*command, "--sheet", str(tmp_path / "found.png")]) == 0
    shown, found = capsys.readouterr().out, json.loads((tmp_path / "f.json").read_text())["found"]
    assert "1.000" in shown and pack.column("id")[11] in shown and found[0]["row"] == 11
    with Image.open(tmp_path / "found.png") as sheet:
        pixels = np.asarray(sheet)
    for row in (one["row"] for one in found):
        assert any(fit(pack.images["touch"][row], 160)[80].tobytes() in line.tobytes() for line in pixels)
    table, other = pq.read_table(known), tmp_path / "other.parquet"
    turned = table.set_column(table.column_names.index("row"), "row", pa.array(range(table.num_rows)[::-1]))
    pq.write_table(turned, other)
    words = [str(other) if word == str(known) else word for word in command]
    assert main([*words, "--sheet", str(tmp_path / "x.png")]) == 2
    assert "other.parquet: its ids are not those of its rows in" in capsys.readouterr().err
    assert main(["find", *[str(tmp_path / "q.png")] * 2, *of]) == 2
    assert "looks at 1 images of touch: 2 are given" in capsys.readouterr().err


def test_a_changed_file_or_another_models_is_refused(known: Path, tmp_path: Path, model: Model) -> None:
    data = bytearray(known.read_bytes())
    data[len(data) // 2] ^= 1
    (tmp_path / "changed").write_bytes(data)
    (tmp_path / "text").write_text("id,group")
    for name, why in (("changed", "CRC"), ("text", "Parquet")):
        with pytest.raises(ValueError, match=f"{name} is no table of mvitac embed: .*{why}"):
            Embeddings(tmp_path / name, model.weights_digest())
    with pytest.raises(ValueError, match="embedded by another model"):
        Embeddings(known, "0" * 64)


def test_vectors_that_another_program_changed_are_refused(known: Path, tmp_path: Path, model: Model) -> None:
    table, file = pq.read_table(known), tmp_path / "other.parquet"
    whole, at = table.column("vision").to_pylist(), table.column_names.index("vision")

    def opened(vectors: list[Any]) -> Embeddings:
        sizes = {len(vector or whole[0]) for vector in vectors or whole}
        column = pa.array(vectors, pa.list_(pa.float32(), sizes.pop() if len(sizes) == 1 else -1))
        pq.write_table(table.slice(0, len(vectors)).set_column(at, "vision", column), file)
        return Embeddings(file, model.weights_digest())

    infinite, none = [[math.inf] * len(whole[0])], [[None, *whole[0][1:]]]
    for vectors in ([None, *whole[1:]], [*none, *whole[1:]], [whole[0][1:], *whole[1:]], [*infinite, *whole[1:]], []):
        with pytest.raises(ValueError, match=r"other\.parquet is damaged: .*(one whole vector|infinite|list_size)"):
            opened(vectors)
    query = np.zeros((1, 32, 32, 3), np.uint8)
    assert opened(whole).find(model, query, "touch", "vision", 3)[1].shape == (1, 3)
    for vectors in ([[math.nan] * len(whole[0])] * 9, [vector[1:] for vector in whole]):
        with pytest.raises(ValueError, match=r"other\.parquet has no vision vectors of \d+ numbers"):
            opened(vectors).find(model, query, "touch", "vision", 3)
    for name, cell in (("label_pattern", 9), ("label_pattern", None), ("row", 0.5), ("id", "\x1b[31m")):
        cells = [cell, *table.column(name).to_pylist()[1:]]
        pq.write_table(table.set_column(table.column_names.index(name), name, pa.array(cells)), file)
        says = r"other\.parquet is damaged: .*(labels of pattern|numbers of rows|control char)"
        with pytest.raises(ValueError, match=says):
            Embeddings(file, model.weights_digest())
    pq.write_table(table.replace_schema_metadata({"mvitac-embeddings": ""}), file)
    with pytest.raises(ValueError, match=r"other\.parquet is no table of mvitac embed"):
        Embeddings(file, model.weights_digest())


def test_by_features_only_like_finds_like(artifact: Path, pack: Pack, tmp_path: Path, model: Model) -> None:
    out = tmp_path / "x.parquet"
    assert main(["embed", str(pack.path), "--model", str(artifact), "--out", str(out)]) == 0
    table = pq.read_table(out)
    assert table.column("id").to_pylist() == pack.column("id").tolist()
    assert table.column("row").to_pylist() == list(range(pack.num))
    expected = model.embed(touch=pack.images["touch"])["touch"].numpy()
    np.testing.assert_allclose(np.stack(table.column("touch").to_numpy()), expected, atol=1e-4)
    known, row = Embeddings(out, model.weights_digest()), int(pack.rows("test")[3])
    assert known.find(model, pack.images["touch"][row], "touch", "touch", 1)[0].tolist() == [[row]]
    with pytest.raises(ValueError, match="touch finds no vision: embed with --shared"):
        known.find(model, pack.images["touch"][row], "touch", "vision", 1)
    with pytest.raises(ValueError, match="num 0: give 1 or more"):
        known.find(model, pack.images["touch"][row], "touch", "touch", 0)
