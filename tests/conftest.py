from __future__ import annotations

import gc
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

# Before anything imports the hub's client, which reads it once: no test reaches the network.
os.environ["HF_HUB_OFFLINE"] = "1"
# Before torch starts its threads, here and in every process that a test starts: sums in one order, whatever the machine,
# and no waiting in circles on one that is busy.
os.environ["OMP_NUM_THREADS"] = "1"
os.environ["OMP_WAIT_POLICY"] = "PASSIVE"

import pytest
from filelock import FileLock

if TYPE_CHECKING:  # pytest's main process, which runs no test, needs no torch
    from mvitac.data.pack import Pack
    from mvitac.deploy.engine import Engine
    from mvitac.model import Model

# A test can kill a process, which loses nothing that was written, but not cut the power.
os.fsync = lambda file: None

pytest.register_assert_rewrite("support")  # before it is imported: a failed assertion there shows its values too


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest tests first, so that no process waits for another's last one."""
    items.sort(key=lambda item: item.path.name != "test_tutorials.py")


@pytest.fixture(scope="session", autouse=True)
def cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    from support import warm  # noqa: F401

    path = tmp_path_factory.mktemp("cache")
    os.environ["MVITAC_CACHE"] = str(path)
    yield path
    gc.unfreeze()  # else libraries report what is left at exit, after pytest's summary


@pytest.fixture(scope="session")
def pack(tmp_path_factory: pytest.TempPathFactory) -> Pack:
    """120 striped pairs at 32 px: 3 classes x 20 instances x 2; split by instance."""
    from support.toy import toy_pack

    return toy_pack(tmp_path_factory.mktemp("toy") / "pack")


@pytest.fixture(scope="session")
def turned(tmp_path_factory: pytest.TempPathFactory) -> Pack:
    """The same pairs, of which those of test are to learn from, and those of train to test."""
    from mvitac.data.build import build
    from support.toy import Toy, swapped

    return build(swapped(Toy()), tmp_path_factory.mktemp("turned") / "pack", size=32, quiet=True)


@pytest.fixture
def two_threads() -> Iterator[None]:
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reports with empty figures, for tests of their text: one has up to thirty, each of which takes 0.2 s to draw."""
    from mvitac.report import figures

    monkeypatch.setattr(figures, "to_png", lambda figure: b"")
    monkeypatch.setattr(figures, "to_svg", lambda figure: "data:image/svg+xml;base64,")


@pytest.fixture(scope="session")
def smoke_run(pack: Pack, tmp_path_factory: pytest.TempPathFactory) -> Path:
    from mvitac.training.loop import train
    from support.training_runs import smoke

    return train(smoke(pack), tmp_path_factory.mktemp("smoke") / "run", quiet=True)


@pytest.fixture(scope="session")
def artifact(smoke_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    from mvitac.deploy.publish import publish

    return publish(smoke_run, tmp_path_factory.mktemp("artifact") / "artifact")


@pytest.fixture(scope="module")
def model(artifact: Path) -> Model:
    from mvitac.deploy.artifact import load

    return load(artifact)


@pytest.fixture
def copy(artifact: Path, tmp_path: Path) -> Path:
    return shutil.copytree(artifact, tmp_path / "artifact")


def made_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], object]) -> Path:
    """A folder that ``make`` fills, in the first of pytest's processes that asks for it. Tests only read it."""
    folder = factory.getbasetemp()
    folder = (folder.parent if "PYTEST_XDIST_WORKER" in os.environ else folder) / name
    with FileLock(f"{folder}.lock"):
        if not folder.exists():
            (making := factory.mktemp(name, numbered=True)).rmdir()
            make(making)
            making.rename(folder)
    return folder


@pytest.fixture(scope="session")
def onnx(artifact: Path, pack: Pack, tmp_path_factory: pytest.TempPathFactory) -> Path:
    from mvitac.deploy.artifact import load
    from mvitac.deploy.export import export

    return made_once(tmp_path_factory, "onnx", lambda out: export(load(artifact), pack, out))


@pytest.fixture(scope="module")
def engine(onnx: Path) -> Engine:
    from mvitac.deploy.engine import Engine

    return Engine(onnx, threads=1)


@pytest.fixture(scope="session")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Pack:
    """The striped pairs with two measured numbers: brightness in levels, weight in N."""
    from support.toy import toy_pack

    return toy_pack(tmp_path_factory.mktemp("measured") / "pack", values=True)


@pytest.fixture(scope="session")
def value_artifact(measured: Pack, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of two steps on ``measured``, published."""
    from mvitac.deploy.publish import publish
    from mvitac.training.loop import train
    from support.training_runs import smoke

    def make(folder: Path) -> None:
        publish(train(smoke(measured, steps=2, eval_every=0), folder / "run", quiet=True), folder / "artifact")

    return made_once(tmp_path_factory, "values", make) / "artifact"


@pytest.fixture(scope="session")
def value_onnx(value_artifact: Path, measured: Pack, tmp_path_factory: pytest.TempPathFactory) -> Path:
    from mvitac.deploy.artifact import load
    from mvitac.deploy.export import export

    return made_once(tmp_path_factory, "value-onnx", lambda out: export(load(value_artifact), measured, out))
