"""The explorer: its facts are arithmetic, its page works in a real browser (skipped where there is no Chromium)."""

from __future__ import annotations

import base64
import contextlib
import html
import json
import re
import socket
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from PIL import Image

import mvitac
from mvitac.cli.main import main
from mvitac.data.pack import Pack
from mvitac.report.explorer_data import LEVELS, ExplorerData
from mvitac.report.guard import MAX_BODY, Guard, as_text
from mvitac.report.palette import COLOURS, MAP_HUES
from support.browser import CHROMIUM, Browser
from support.processes import begin
from support.toy import reordered


@pytest.fixture(scope="module")
def land(artifact: Path, pack: Pack) -> ExplorerData:
    return ExplorerData(mvitac.load(artifact), pack)


def decode(text: str) -> dict[str, Any]:
    value = json.loads(text)
    value["xy"] = np.frombuffer(base64.b64decode(value["xy"]), "<u2").reshape(2, -1)
    value["row"] = np.frombuffer(base64.b64decode(value["row"]), "<i4")
    value["group"] = np.frombuffer(base64.b64decode(value["group"]), "<u2")
    return value


def test_points_carry_place_colour_and_row(land: ExplorerData, pack: Pack) -> None:
    value = decode(land.points("both", "label", "test", "pattern"))
    rows = pack.rows("test")
    assert np.array_equal(value["row"], rows)
    names = [value["legend"][c] for c in value["group"]]
    assert names == [pack.spec.tasks[0].classes[i] for i in pack.column("label_pattern")[rows]]
    np.testing.assert_allclose(value["xy"].T / 65535, land.plane("both")[rows], atol=1e-4)


def test_more_classes_than_a_byte_counts(land: ExplorerData, monkeypatch: pytest.MonkeyPatch) -> None:
    used = np.arange(300)
    monkeypatch.setattr(land, "classes", {"pattern": [f"class {i}" for i in used]})
    monkeypatch.setattr(land, "rows", used)
    monkeypatch.setattr(land, "labels", {"pattern": used})
    monkeypatch.setattr(land, "plane", lambda modality: np.zeros((300, 2)))
    monkeypatch.setattr(land, "shown", lambda *a, **k: used)
    value = decode(land.points("both", "label", "all", "pattern"))
    assert [value["legend"][c] for c in value["group"]] == [f"class {i}" for i in used]


def test_at_most_ten_classes_are_coloured_first(land: ExplorerData, monkeypatch: pytest.MonkeyPatch) -> None:
    """The largest ones, in the order of the classes; the rest is gray until it is chosen."""
    labels = np.repeat(np.arange(13), [1, 9, 9, 9, 2, 9, 9, 9, 9, 9, 9, 9, 3])
    monkeypatch.setattr(land, "classes", {"pattern": [f"class {i}" for i in range(13)]})
    monkeypatch.setattr(land, "labels", {"pattern": labels})
    monkeypatch.setattr(land, "plane", lambda modality: np.zeros((len(labels), 2)))
    monkeypatch.setattr(land, "shown", lambda *a, **k: np.arange(len(labels)))
    value = json.loads(land.points("both", "label", "all", "pattern"))
    assert len(value["legend"]) == 13 and len(value["hues"]) == 10
    assert value["coloured"] == [f"class {i}" for i in range(13) if i not in (0, 4, 12)]


def test_the_axes_say_what_they_are(land: ExplorerData) -> None:
    x = land.x["touch"] - land.x["touch"].mean(0)
    shares = np.linalg.svd(x, compute_uv=False) ** 2
    shares = 100 * shares / shares.sum()
    assert json.loads(land.points("touch", "split", "all", None))["axes"] == [
        f"principal component {i + 1} of touch ({shares[i]:.0f} % of the variance)" for i in (0, 1)
    ]


@pytest.mark.parametrize("dark", [0, 1])
def test_the_colours_of_the_map_are_told_apart(dark: int) -> None:
    """Also from gray and the page. Distances are OKLab's (Ottosson 2020); .02 is about the least that an eye sees."""
    colours = [COLOURS[name][dark] for name in (*MAP_HUES, "grey4", "card")]
    srgb = np.array([[int(c[i : i + 2], 16) / 255 for i in (1, 3, 5)] for c in colours])
    light = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    cones = [
        [0.41222147, 0.53633254, 0.05144599],
        [0.2119035, 0.6806995, 0.10739696],
        [0.08830246, 0.28171884, 0.62997870],
    ]
    opponent = [
        [0.21045426, 0.79361779, -0.00407205],
        [1.97799850, -2.42859221, 0.45059371],
        [0.02590404, 0.78277177, -0.80867577],
    ]
    lab = np.cbrt(light @ np.array(cones).T) @ np.array(opponent).T
    apart = np.linalg.norm(lab[:, None] - lab, axis=2) + 9 * np.eye(len(lab))
    assert len(MAP_HUES) == 10 and apart.min() > 0.07


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
    value = decode(land.points("both", "error", "all", "pattern"))
    named = np.array([value["legend"][c] for c in value["group"]])
    assert np.array_equal(np.flatnonzero(named == "wrong"), wrong)
    assert "(probe: " in land.describe(int(wrong[0]))


def test_neighbours_leave_out_the_point_itself(land: ExplorerData) -> None:
    pairs = land.neighbours(land.x["touch"][5:6], "touch", 4, without=5)
    every = land.x["touch"] @ land.x["touch"][5]
    every[5] = -2
    assert [i for i, _ in pairs] == np.argsort(-every, kind="stable")[:4].tolist()


def test_a_dropped_picture_is_classified_and_finds_itself(land: ExplorerData, pack: Pack) -> None:
    said, pairs = land.query(np.array(pack.images["touch"][17]), "touch", 3)
    assert pairs[0][0] == 17 and pairs[0][1] == pytest.approx(1, abs=1e-4)
    assert set(said) == {"pattern", "bright"} and sum(said["pattern"].values()) == pytest.approx(1, abs=1e-4)


def test_a_pack_of_other_numbers_or_tasks(land: ExplorerData, artifact: Path, pack: Pack) -> None:
    """The probes' answers are compared by name; a task that the pack lacks is answered all the same."""
    other = reordered(pack)
    other.spec = replace(other.spec, tasks=other.spec.tasks[:1])
    found = ExplorerData(mvitac.load(artifact), other)
    wrong = land.shown("all", "pattern", mistakes=True)
    assert np.array_equal(found.shown("all", "pattern", mistakes=True), wrong)
    assert found.describe(int(wrong[0])).partition(" · light")[0] in land.describe(int(wrong[0]))
    picture = np.array(pack.images["touch"][17])
    assert found.query(picture, "touch", 3)[0] == land.query(picture, "touch", 3)[0]


def test_fewer_rows_are_of_every_class(artifact: Path, pack: Pack) -> None:
    """Although the pack's three classes take turns, and every third row would be of one."""
    few = ExplorerData(mvitac.load(artifact), pack, limit=40)
    assert len(few.rows) == 40 and (np.diff(few.rows) > 0).all()
    assert np.bincount(few.labels["pattern"]).min() >= 8


def test_a_run_that_is_not_finished_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "checkpoint.pt").touch()
    assert main(["explore", str(tmp_path / "run")]) == 2
    assert "the run is not finished" in capsys.readouterr().err


def test_values_colour_the_map(land: ExplorerData, monkeypatch: pytest.MonkeyPatch) -> None:
    """The lowest and the highest value have the ends of the scale, a row without one is gray; captions tell the value."""
    force = np.arange(len(land.rows), dtype=float)
    force[3] = np.nan
    monkeypatch.setattr(land, "values", {"force_n (N)": force})
    value = decode(land.points("both", "label", "all", "force_n (N)"))
    names = np.array(value["legend"])[value["group"]]
    assert names[3] == "not measured" and (names[0], names[-1]) == ("0", str(LEVELS - 1))
    assert "not measured" not in value["coloured"] and len(value["hues"]) == len(value["coloured"]) == LEVELS
    measured = names[~np.isnan(force)].astype(int)
    assert (np.diff(measured) >= 0).all() and len(set(measured)) == LEVELS
    low, high = np.nanpercentile(force, [1, 99])
    assert value["bar"] == [f"{low:.3g}", f"{high:.3g}", "force_n (N)"]
    some = decode(land.points("both", "label", "test", "force_n (N)"))
    assert some["bar"] == value["bar"]  # a filter leaves the scale
    assert land.describe(5).endswith(" · force_n 5 N") and "force_n" not in land.describe(3)
    assert land.name(5, "force_n (N)") == f"{land.name(5)}, force_n 5 N" and land.name(5, "pattern") == land.name(5)
    assert land.same_class(0, 1, "force_n (N)") is None


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    if not CHROMIUM:
        pytest.skip("no Chromium on the PATH: the page is not tested (apt-get install chromium)")
    opened = Browser(tmp_path_factory.mktemp("profile"))
    yield opened
    opened.close()


def centre_of_a_point(browser: Browser, land: ExplorerData, index: int) -> tuple[float, float]:
    """Where scatter.js draws row ``index`` before any zoom."""
    left, top, width, height = browser.run(
        "(() => { const b = document.querySelector('.map canvas').getBoundingClientRect();"
        " return [b.left, b.top, b.width, b.height] })()"
    )
    x, y = land.plane("both")[index]
    return left + 30 + x * (width - 42), top + 12 + y * (height - 42)  # the margins of scatter.js


POINTS = "document.querySelector('[data-points]').dataset.points"
CLICK_BOX = "document.querySelector('input[type=checkbox]').click()"


def free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


@contextlib.contextmanager
def serving(folder: Path, port: int, work: Callable[..., int | None], *given: Any) -> Iterator[None]:
    """``work(*given)``, which serves, in a process of its own, until it answers on ``port``."""
    process = begin(work, *given, output=folder / "said")
    try:
        while True:
            with socket.socket() as one:
                if one.connect_ex(("127.0.0.1", port)) == 0:
                    break
            process.join(0.1)
            assert process.is_alive(), (folder / "said").read_text()[-2000:]
        yield
    finally:
        process.kill()
        process.join()


@pytest.fixture(scope="module")
def ports(
    artifact: Path, smoke_run: Path, pack: Pack, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[tuple[int, int]]:
    """Of `mvitac explore` with two models on the striped pairs, and of the page of ``serve_many``, in one process."""
    port, of_many = free_port(), free_port()
    command = ["explore", str(artifact), str(smoke_run), "--on", str(pack.path), "--port", str(port)]
    with serving(tmp_path_factory.mktemp("explored"), port, serve_both, command, of_many, artifact, pack.path):
        yield port, of_many


@pytest.fixture(scope="module")
def explored(ports: tuple[int, int]) -> int:
    return ports[0]


def serve_both(command: list[str], of_many: int, artifact: Path, pack: Path) -> int:
    serve_many(of_many, artifact, pack)
    return main(command)


def serve_many(port: int, artifact: Path, pack: Path) -> None:
    """Serve 100,000 rows, in which every answer is right."""
    from mvitac.report.explorer import page, serve

    land = ExplorerData(mvitac.load(artifact), Pack(pack))
    i = np.arange(100_000) % len(land.rows)
    land.rows, land.split = land.rows[i], np.full(len(i), "test")
    noise = np.random.default_rng(0).normal(0, 0.05, (len(i), 64)).astype("f4")
    land.x = {m: x[i] + noise for m, x in land.x.items()}
    land.labels = {t: x[i] for t, x in land.labels.items()}
    land.guess = dict(land.labels)
    serve(page({"run": land}), port=port, wait=False)


def listeners(port: int) -> set[str]:
    """Addresses on which something listens on ``port`` (Linux; IPv4 and IPv6)."""
    found = set()
    for table, loopback in (("tcp", "0100007F"), ("tcp6", "")):
        for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]:
            local, state = line.split()[1], line.split()[3]
            if state == "0A" and local.endswith(f":{port:04X}"):
                found.add("127.0.0.1" if local.split(":")[0] == loopback else local)
    return found


def test_the_page_in_a_browser(browser: Browser, explored: int, land: ExplorerData, pack: Pack, tmp_path: Path) -> None:
    """Map, hover, click, filter, two runs side by side, a phone's width; listens on loopback only."""
    assert listeners(explored) == {"127.0.0.1"}
    browser.resize(1200, 900)
    browser.open(f"http://127.0.0.1:{explored}")
    browser.wait(f"{POINTS} == {len(pack.rows('test'))}")
    assert browser.run("document.querySelectorAll('.map canvas').length") == 2
    row = int(pack.rows("test")[0])

    def hover() -> None:
        browser.mouse("mouseMoved", 1, 1)
        browser.mouse("mouseMoved", *centre_of_a_point(browser, land, row))

    browser.until("document.querySelector('.tip').style.display == 'block'", hover)
    shown = browser.run("document.querySelector('.tip').textContent")
    pictured = browser.run("document.querySelectorAll('.tip img').length")
    assert pictured == 2 and shown.split(" ·")[0] in pack.column("id")
    browser.until(
        "document.querySelectorAll('.found img').length == 12",
        lambda: browser.click(*centre_of_a_point(browser, land, row)),
    )
    check_marks(browser, land, row)
    check_legend(browser)
    check_keys(browser)
    check_zoom(browser, land, row)
    browser.run(CLICK_BOX)
    wrong = len(land.shown("test", "pattern", mistakes=True))
    browser.wait(f"{POINTS} == {wrong}")
    browser.resize(390, 844, mobile=True)
    browser.wait("document.documentElement.scrollWidth <= 390")
    browser.wait("document.querySelector('.map canvas').clientWidth > 200")
    browser.wait("[...document.querySelectorAll('.form > *')].every((e) => e.scrollWidth <= e.clientWidth)")
    browser.screenshot(tmp_path / "phone.png")
    with Image.open(tmp_path / "phone.png") as picture:
        assert picture.size == (390, 844)
    assert browser.problems == []


def check_marks(browser: Browser, land: ExplorerData, row: int) -> None:
    """Every neighbour says whether it has the class of the clicked point, below its image and not over it."""
    labels = land.labels["pattern"]
    marks = (
        "[...document.querySelectorAll('.found')].map((f) => [...f.querySelectorAll('b')].map((b) => b.textContent))"
    )
    expected = [
        [f"{'✓' if labels[i] == labels[row] else '✕'} {land.classes['pattern'][labels[i]]}" for i, _ in found]
        for found in (land.neighbours(land.x[m][row : row + 1], m, 6, without=row) for m in land.x)
    ]
    assert browser.run(marks) == expected and {"✓", "✕"} >= {mark[0] for found in expected for mark in found}
    assert browser.run(
        "[...document.querySelectorAll('.found > div')].every((d) => d.querySelector('b').getBoundingClientRect().top"
        " >= d.querySelector('img').getBoundingClientRect().bottom)"
    )


def check_legend(browser: Browser) -> None:
    """A class that is no longer chosen is drawn in gray."""
    press = "document.querySelector('.legend button').click()"
    pressed = "document.querySelectorAll('.legend')[0].querySelectorAll('[aria-pressed=true]').length"
    browser.run("window.before = document.querySelector('.map canvas').toDataURL()")
    browser.run(press)
    assert browser.run(pressed) == 2
    assert browser.run("document.querySelector('.map canvas').toDataURL() != window.before")
    browser.run(press)
    assert browser.run(pressed) == 3


def check_keys(browser: Browser) -> None:
    """From point to point by arrow keys, neighbours by Enter."""

    def press(key: str) -> None:
        browser.send("Input.dispatchKeyEvent", type="keyDown", key=key)
        browser.send("Input.dispatchKeyEvent", type="keyUp", key=key)

    told = "document.querySelector('.tip').textContent"
    browser.mouse("mouseMoved", 1, 1)
    browser.run("document.querySelector('.map canvas').focus()")
    press("ArrowRight")
    browser.wait("document.querySelector('.tip').style.display == 'block'")
    browser.run(f"window.before = {told}")
    press("ArrowRight")
    browser.wait(f"{told} != window.before")
    press("Enter")
    browser.wait(f"document.body.innerText.split({told}).length == 3")  # in the tip and above the neighbours
    press("Escape")
    browser.wait("document.querySelector('.tip').style.display == 'none'")


def check_zoom(browser: Browser, land: ExplorerData, row: int) -> None:
    """By wheel and by two fingers: the map changes, and what was under pointer or fingers is still there."""
    x, y = centre_of_a_point(browser, land, row)
    name = str(land.pack.column("id")[row])

    def pinch() -> None:
        for kind, apart in (("touchStart", 20), ("touchMove", 40), ("touchMove", 60)):
            points = [{"x": x - apart, "y": y, "id": 0}, {"x": x + apart, "y": y, "id": 1}]
            browser.send("Input.dispatchTouchEvent", type=kind, touchPoints=points)
        browser.send("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])

    def hover() -> None:
        browser.mouse("mouseMoved", 1, 1)
        browser.mouse("mouseMoved", x, y)

    for act in (lambda: browser.mouse("mouseWheel", x, y, deltaX=0, deltaY=-400), pinch):
        browser.mouse("mouseMoved", 1, 1)
        browser.run("window.before = document.querySelector('.map canvas').toDataURL()")
        act()
        browser.wait("document.querySelector('.map canvas').toDataURL() != window.before")
        browser.until(f"document.querySelector('.tip').textContent.startsWith({name!r})", hover)


LISTENING = {"host": "127.0.0.1:7860"}
REFUSED: list[tuple[dict[str, str], int]] = [
    ({"host": "evil.example:7860"}, 403),  # its name was made to point to 127.0.0.1
    ({"host": "192.0.2.1:7860"}, 403),
    ({"host": ""}, 403),
    ({**LISTENING, "origin": "http://evil.example"}, 403),
    ({**LISTENING, "origin": "http://127.0.0.1:8000"}, 403),  # another page of this machine
    ({**LISTENING, "origin": "null"}, 403),
    ({**LISTENING, "origin": "http://["}, 403),
    ({**LISTENING, "sec-fetch-site": "cross-site", "sec-fetch-mode": "no-cors"}, 403),
    ({**LISTENING, "content-length": str((20 << 20) + 1)}, 413),
    ({**LISTENING, "transfer-encoding": "chunked"}, 411),  # of any length
]


def test_the_server_answers_only_itself() -> None:
    """Names of this machine and the page's own origin; at most 20 MB; pages load nothing from elsewhere."""
    guard = Guard(None, "127.0.0.1")
    for headers, status in REFUSED:
        found = guard.refuses({k.encode(): v.encode() for k, v in headers.items()})
        assert found and found[0] == status, headers
    for headers in (LISTENING, {"host": "localhost:1", "origin": "http://localhost:1"}, {"host": "[::1]:7860"}):
        assert guard.refuses({k.encode(): v.encode() for k, v in headers.items()}) is None, headers
    network = Guard(None, "0.0.0.0")
    assert (
        network.allows("192.0.2.1:7860") and network.allows(socket.gethostname()) and not network.allows("evil.example")
    )


def test_the_running_server_refuses_rebinding_and_large_uploads(explored: int) -> None:
    address = f"http://127.0.0.1:{explored}/"
    own = httpx.get(address)
    assert own.status_code == 200 and "default-src 'self'" in own.headers["content-security-policy"]
    assert httpx.get(address, headers={"host": "evil.example"}).status_code == 403
    cross = httpx.get(f"{address}config", headers={"origin": "http://evil.example"})
    assert cross.status_code == 403 and "access-control-allow-origin" not in cross.headers
    files = {"files": ("big.png", bytes(MAX_BODY + 1))}
    assert httpx.post(f"{address}gradio_api/upload", files=files).status_code == 413
    assert httpx.post(f"{address}gradio_api/upload", content=iter([b"chunk"])).status_code == 411


def test_labels_are_text_in_markdown() -> None:
    """No image or link, of which a browser would fetch the address."""
    from markdown_it import MarkdownIt

    render = MarkdownIt("gfm-like", {"linkify": False}).render
    for label in (
        "![x](http://evil/x.png)",
        "<img src=http://evil>",
        "[a](javascript:b)",
        "**b** `c` &lt;",
        "http://evil",
    ):
        text = render(f"**{as_text(label)}**")
        assert "<img" not in text and "<a" not in text, text
        assert html.unescape(re.sub("<[^>]*>", "", text)).strip() == label


def test_a_page_of_very_many_and_of_none(browser: Browser, ports: tuple[int, int]) -> None:
    """100,000 rows, in which every answer is right: filtered to its mistakes, there is nothing to show."""
    browser.resize(1200, 900)
    browser.open(f"http://127.0.0.1:{ports[1]}")
    browser.wait(f"{POINTS} == 100000")
    middle = browser.run(
        "(() => { const b = document.querySelector('.map canvas').getBoundingClientRect();"
        " return [b.left + b.width / 2, b.top + b.height / 2] })()"
    )

    def hover() -> None:
        browser.mouse("mouseMoved", 1, 1)
        browser.mouse("mouseMoved", *middle)

    browser.until("document.querySelectorAll('.tip img').length == 2", hover)
    browser.until("document.querySelectorAll('.found img').length == 12", lambda: browser.click(*middle))
    browser.run(CLICK_BOX)
    browser.wait(f"{POINTS} == 0")
    assert "nothing to show" in browser.run("document.querySelector('.count').textContent")
    assert browser.problems == []
