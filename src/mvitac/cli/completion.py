"""``mvitac completion``: a script by which bash and zsh complete commands, options and the names of choices."""

import contextlib
import importlib
import io
import re
from collections.abc import Iterable, Iterator

from mvitac.cli.main import COMMANDS

_SCRIPT = """\
# Completion of mvitac for bash, and for zsh after: autoload -U bashcompinit && bashcompinit
_mvitac() {
  local word=${COMP_WORDS[COMP_CWORD]} before=${COMP_WORDS[COMP_CWORD-1]} words=""
  local command=${COMP_WORDS[1]}
  [[ $command == data && $COMP_CWORD -gt 2 ]] && command="data ${COMP_WORDS[2]}"
  if [[ $COMP_CWORD == 1 ]]; then
    words="@commands"
  elif [[ $COMP_CWORD == 2 && $command == data ]]; then
    words="@data"
  else
    case "$before" in
@choices
    esac
    if [[ $word == -* ]]; then
      case "$command" in
@options
      esac
    fi
  fi
  COMPREPLY=($(compgen -W "$words" -- "$word"))
}
complete -o default -F _mvitac mvitac
"""


def completion(argv: list[str]) -> None:
    """mvitac completion bash|zsh"""
    if argv not in (["bash"], ["zsh"]):
        raise ValueError("name the shell: mvitac completion bash (or zsh); docs/install.md says where the script goes")
    commands = dict.fromkeys(name.split()[0] for name in COMMANDS)
    lines = {
        "commands": " ".join(commands),
        "data": " ".join(name.split()[1] for name in COMMANDS if name.startswith("data ")),
        "choices": _cases({f"--{name}": values for name, values in _choices().items()}),
        "options": _cases({name: _options(name) for name in COMMANDS if name != "completion"}),
    }
    print(re.sub("@([a-z]+)", lambda found: lines[found[1]], _SCRIPT), end="")


def _cases(words: dict[str, Iterable[str]]) -> str:
    return "\n".join(f'        "{name}") words="{" ".join(values)}" ;;' for name, values in words.items())


def _choices() -> dict[str, list[str]]:
    """Option that chooses other options -> the names it takes."""
    from mvitac.datasets.base import DatasetConfig
    from mvitac.experiments.paper_plans import PLANS
    from mvitac.methods.base import MethodConfig
    from mvitac.recipes import RECIPES

    found = {"data": DatasetConfig.choices, "method": MethodConfig.choices, "recipe": RECIPES, "plan": PLANS}
    return {name: list(values) for name, values in found.items()}


def _options(command: str) -> list[str]:
    """Every option that the help of ``command`` shows, over all datasets and methods."""
    module, function = COMMANDS[command].split(":")
    run = getattr(importlib.import_module(f"mvitac.cli.{module}"), function)
    found: dict[str, None] = {}
    for words in _variants(command):
        with contextlib.redirect_stdout(io.StringIO()) as shown, contextlib.suppress(SystemExit):
            run([*words, "--help"])
        found |= dict.fromkeys(re.findall(r"^[│| ]*(--[a-z][\w.-]*)", shown.getvalue(), re.MULTILINE))
    return sorted({*found, "--help"})


def _variants(command: str) -> Iterator[list[str]]:
    """The words before --help that change what it shows."""
    choices = _choices()
    if command == "data simulate":
        yield from (["materials"], ["grasps"])
        return
    yield []
    if command in ("data pack", "data check", "pretrain", "compare"):
        yield from (["--data", name] for name in choices["data"])
    if command == "pretrain":
        yield from (["--method", name] for name in choices["method"])
