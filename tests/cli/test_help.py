"""The stored help of each command is what the command says of itself, and it is printed at once."""

import contextlib
import importlib
import os
import subprocess
import sys

import pytest

from mvitac.cli.main import COMMANDS, HELP, help_file, main


@pytest.mark.parametrize("command", COMMANDS)
def test_help_is_golden(command: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Every option with its default and meaning. After a wanted change: MVITAC_GOLDEN=1 pytest -k golden"""
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setenv("NO_COLOR", "1")
    monkeypatch.setenv("TERM", "dumb")
    module, function = COMMANDS[command].split(":")
    with contextlib.suppress(SystemExit):
        getattr(importlib.import_module(f"mvitac.cli.{module}"), function)(["--help"])
    text = "\n".join(line.rstrip() for line in capsys.readouterr().out.splitlines()) + "\n"
    path = help_file(command)
    if "MVITAC_GOLDEN" in os.environ:
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
    assert text == path.read_text() and main([*command.split(), "--help"]) == 0 and capsys.readouterr().out == text


def test_help_imports_nothing_heavy() -> None:
    code = (
        "import sys; from mvitac.cli.main import COMMANDS, main\n"
        f"assert not any(main([*name.split(), '--help']) for name in {['', *COMMANDS]!r})\n"
        "sys.exit(bool({'torch', 'tyro', 'numpy', 'rich'} & set(sys.modules)))"
    )
    subprocess.run([sys.executable, "-c", code], check=True, stdout=subprocess.DEVNULL)


def test_helps_and_the_list_are_of_the_commands() -> None:
    assert {path.stem for path in help_file("").parent.glob("*.txt")} == {name.replace(" ", "-") for name in COMMANDS}
    assert all(f"  {name} " in HELP for name in COMMANDS) and all(len(line) <= 80 for line in HELP.splitlines())
