"""New folders: made by one process at a time, complete or not at all."""

from pathlib import Path

import pytest
from filelock import FileLock

from mvitac.data.pack import Pack
from mvitac.deploy.artifact import load
from mvitac.deploy.export import export
from mvitac.deploy.publish import publish
from mvitac.system.locks import Busy, new_folder

COMMANDS = {
    "publish": lambda run, pack, out: publish(run, out, pack),
    "export": lambda run, pack, out: export(load(run), pack, out),
}


@pytest.mark.parametrize("name", COMMANDS)
def test_what_another_process_writes_is_left_to_it(name: str, smoke_run: Path, pack: Pack, tmp_path: Path) -> None:
    (tmp_path / "out.partial").mkdir()
    (tmp_path / "out.partial" / "theirs").touch()
    with FileLock(tmp_path / "out.lock"), pytest.raises(Busy, match="is being written by another process"):
        COMMANDS[name](smoke_run, pack, tmp_path / "out")
    assert (tmp_path / "out.partial" / "theirs").exists() and not (tmp_path / "out").exists()


def test_a_new_folder_is_complete_or_not_there(tmp_path: Path) -> None:
    (tmp_path / "out.partial").mkdir()
    (tmp_path / "out.partial" / "of a killed process").touch()
    with pytest.raises(ZeroDivisionError), new_folder(tmp_path / "out") as partial:
        (partial / f"{1 / len(list(partial.iterdir()))}").touch()  # it is empty
    assert not list(tmp_path.iterdir())
    with new_folder(tmp_path / "out") as partial:
        (partial / "file").touch()
    assert [path.name for path in tmp_path.rglob("*")] == ["out", "file"]
    with pytest.raises(ValueError, match="already exists"), new_folder(tmp_path / "out"):
        pass
    assert [path.name for path in tmp_path.rglob("*")] == ["out", "file"]
