"""``mvitac ablate``."""

from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from mvitac.cli.options import check_json, parse, printed_to, save_json
from mvitac.control.ablate import PLAUSIBLE, open_policy, read_episodes, report, suite_episodes, suite_policy
from mvitac.control.ablate import ablate as compare
from mvitac.control.result import find_suite, shipped
from mvitac.control.video import film, webp
from mvitac.data.pack import Pack
from mvitac.system.files import write_atomic
from mvitac.system.progress import shown


@dataclass(frozen=True, kw_only=True)
class _Options:
    """Does a policy use touch? Replace what it feels and sees in episodes, and compare what it does."""

    policy: Positional[str]
    """FILE.py:function of an observation, or the folder of a LeRobot policy. In episodes of a suite also an encoder, or
    "pixels": it learns the task as the suite's rows do."""
    data: Path
    """Folder of a pack: its touch groups are the episodes, and its values "action" what was demonstrated. Or a suite, a
    task and a condition for a closed loop: "insert-v1/both/30", "servo-v1/corner/known sensor"."""
    out: Path | None = None
    """Of a suite, also write a film (.webp) of its first episode, with its own and with another's touch."""
    json: Path | None = None
    """Also write everything that is printed to this file; - = stdout, and the tables to stderr."""


def ablate(argv: list[str]) -> None:
    options = parse(_Options, argv, "ablate")
    check_json(options.json)
    check_json(options.out, "--out")
    if options.out and options.out.suffix != ".webp":
        raise ValueError(f"--out {options.out}: give the name of a .webp file")
    name, *cell = str(options.data).split("/")
    if name in shipped():
        suite, cell = find_suite(name), tuple(cell)
        episodes = suite_episodes(suite, cell)
        policy = suite_policy(suite, cell, options.policy)
    elif not options.data.exists():
        known = "a pack's folder, nor a suite, a task and a condition"
        raise ValueError(f"--data {options.data} is neither {known}; suites are {', '.join(shipped())}")
    elif options.out:
        raise ValueError(f"--out is a film of a suite, and --data {options.data} is none: leave it out")
    else:
        policy, episodes = open_policy(options.policy), read_episodes(Pack(options.data))
    with shown():
        result = compare(policy, episodes)
    print(report(result), file=printed_to(options.json))
    save_json(options.json, result, sealed=True)
    if options.out:
        other = ("touch of another episode", policy, PLAUSIBLE[0])
        runs = [("as it is", policy, ""), *[other] * ("touch" in episodes.senses)]
        write_atomic(options.out, lambda file: file.write(webp(film(episodes, runs))))
        print(f"written: {options.out}", file=printed_to(options.json))
