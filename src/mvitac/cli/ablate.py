"""``mvitac ablate``."""

from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from mvitac.cli.options import check_json, parse, printed_to, save_json
from mvitac.control.ablate import ablate as compare
from mvitac.control.ablate import open_policy, read_episodes, report
from mvitac.data.pack import Pack
from mvitac.system.progress import shown


@dataclass(frozen=True, kw_only=True)
class _Options:
    """Does a policy use touch? Replace what it feels and sees in recorded episodes, and compare what it does."""

    policy: Positional[str]
    """module:function or FILE.py:function of an observation, or the folder of a LeRobot policy."""
    data: Path
    """Folder of a pack: its groups are the episodes, and its values "action" what was demonstrated."""
    json: Path | None = None
    """Also write everything that is printed to this file; - = stdout, and the tables to stderr."""


def ablate(argv: list[str]) -> None:
    """mvitac ablate POLICY --data EPISODES [--json FILE]"""
    options = parse(_Options, argv, "ablate")
    check_json(options.json)
    policy, episodes = open_policy(options.policy), read_episodes(Pack(options.data))
    with shown():
        result = compare(policy, episodes)
    print(report(result), file=printed_to(options.json))
    save_json(options.json, result, sealed=True)
