"""The explorer: its facts are arithmetic, its page works in a real browser (skipped where there is no Chromium)."""

from __future__ import annotations

import json
import shutil
import socket
import subprocess
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import httpx
import numpy as np
import pytest

import mvitac
from mvitac.cli.main import main
from mvitac.data.pack import Pack
from mvitac.report.explorer_data import LEVELS, ExplorerData
from support.processes import begin
from support.toy import reordered

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), "")


@pytest.fixture(scope="module")
def land(artifact: Path, pack: Pack) -> ExplorerData:
    return ExplorerData(mvitac.load(artifact), pack)


def test_points_carry_place_colour_and_row(land: ExplorerData, pack: Pack) -> None:
    value = json.loads(land.points("both", "label", "test", "pattern"))
    rows = pack.rows("test")
    assert np.array_equal(value["row"], rows)
    names = [value["legend"][c] for c in value["group"]]
    assert names == [pack.spec.tasks[0].classes[i] for i in pack.column("label_pattern")[rows]]
    np.testing.assert_allclose(np.transpose([value["x"], value["y"]]), land.plane("both")[rows], atol=1e-4)


def test_the_plane_holds_the_most_variance(land: ExplorerData) -> None:
    x = land.x["touch"] - land.x["touch"].mean(0)
    first, second = land.plane("touch").T
    scores = np.linalg.svd(x, full_matrices=False)
    for found, expected in ((first, scores[0][:, 0]), (second, scores[0][:, 1])):
        assert abs(np.corrcoef(found, expected)[0, 1]) > 0.98  # the ends are clipped


def test_errors_are_the_probes(land: ExplorerData, pack: Pack, artifact: Path) -> None:
    said = mvitac.load(artifact).predict(vision=pack.images["vision"], touch=pack.images["touch"])["pattern"]
    wrong = np.flatnonzero(said.argmax(1).numpy() != pack.column("label_pattern"))
    assert 0 < len(wrong) < pack.num
    assert np.array_equal(land.shown("all", "pattern", mistakes=True), wrong)
    assert "(probe: " in land.describe(int(wrong[0]))


def test_neighbours_leave_out_the_point_itself(land: ExplorerData) -> None:
    pairs = land.neighbours(land.x["touch"][5:6], "touch", 4, without=5)
    every = land.x["touch"] @ land.x["touch"][5]
    every[5] = -2
    assert [i for i, _ in pairs] == np.argsort(-every, kind="stable")[:4].tolist()


def test_a_pack_of_other_numbers_or_tasks(land: ExplorerData, artifact: Path, pack: Pack) -> None:
    """The probes' answers are compared by name; a task that the pack lacks is answered all the same."""
    other = reordered(pack)
    other.spec = replace(other.spec, tasks=other.spec.tasks[:1])
    found = ExplorerData(mvitac.load(artifact), other)
    wrong = land.shown("all", "pattern", mistakes=True)
    assert np.array_equal(found.shown("all", "pattern", mistakes=True), wrong)
    assert found.describe(int(wrong[0])).partition(" · light")[0] in land.describe(int(wrong[0]))


def test_values_colour_the_map(land: ExplorerData, monkeypatch: pytest.MonkeyPatch) -> None:
    """The lowest and the highest value have the ends of the scale, a row without one is gray; captions tell the value."""
    force = np.arange(len(land.rows), dtype=float)
    force[3] = np.nan
    monkeypatch.setattr(land, "values", {"force_n (N)": force})
    value = json.loads(land.points("both", "label", "all", "force_n (N)"))
    names = np.array(value["legend"])[value["group"]]
    assert names[3] == "not measured" and (names[0], names[-1]) == ("0", str(LEVELS - 1))
    assert "not measured" not in value["coloured"] and len(value["hues"]) == len(value["coloured"]) == LEVELS
    measured = names[~np.isnan(force)].astype(int)
    assert (np.diff(measured) >= 0).all() and len(set(measured)) == LEVELS
    low, high = np.nanpercentile(force, [1, 99])
    assert value["bar"] == [f"{low:.3g}", f"{high:.3g}", "force_n (N)"]
    some = json.loads(land.points("both", "label", "test", "force_n (N)"))
    assert some["bar"] == value["bar"]  # a filter leaves the scale
    assert land.describe(5).endswith(" · force_n (N) 5") and "force_n" not in land.describe(3)
    assert land.same_class(0, 1, "force_n (N)") is None


# -- the page ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def address(artifact: Path, pack: Pack, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """`mvitac explore` on the striped pairs, in a process of its own."""
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        port = one.getsockname()[1]
    command = ["explore", str(artifact), "--on", str(pack.path), "--port", str(port)]
    said = tmp_path_factory.mktemp("explored") / "said"
    process = begin(main, command, output=said)
    try:
        while True:
            with socket.socket() as one:
                if one.connect_ex(("127.0.0.1", port)) == 0:
                    break
            process.join(0.1)
            assert process.is_alive(), said.read_text()[-2000:]
        yield f"http://127.0.0.1:{port}/"
    finally:
        process.kill()
        process.join()


def test_the_server_answers_to_its_own_names_only(address: str) -> None:
    """A site that lets its own name point to 127.0.0.1 is refused."""
    assert httpx.get(address).status_code == 200
    assert httpx.get(address, headers={"host": "evil.example"}).status_code == 400


def test_the_page_in_a_browser(address: str, pack: Pack, tmp_path: Path) -> None:
    """The script draws every test row."""
    if not CHROMIUM:
        pytest.skip("no Chromium on the PATH: the page is not tested (apt-get install chromium)")
    flags = [
        "--headless=new",
        "--no-sandbox",
        "--disable-gpu",
        "--disable-dev-shm-usage",
        "--virtual-time-budget=60000",
    ]
    command = [CHROMIUM, *flags, f"--user-data-dir={tmp_path}", "--dump-dom", address]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert f'data-points="{len(pack.rows("test"))}"' in done.stdout, done.stderr[-2000:]
