"""Call every command with odd values of every option of its help: no traceback, no hang, only known exit codes.

    python -m benchmarks.fuzz --calls 1000            # spread evenly over all commands, options and values
    python -m benchmarks.fuzz --commands live find --calls 0      # 0 = every call that can be generated

The options are read from ``--help``. Each call is one that works, with one option added, replaced, doubled, left out or
without its value. It runs in a process forked from one that has imported the library, in a fresh copy of a small folder,
without network. After ``--limit`` seconds it gets SIGINT, and must then end within 10 s.

A call fails if it shows a traceback, ends with another code than 0, 1, 2 and 130, does not end, or ends with 2 without one
line ``mvitac: error: ...``. The result is printed as JSON; the exit code is 1 if a call failed.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import io
import json
import os
import re
import resource
import shlex
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.faults import COMMANDS as WRITING
from benchmarks.faults import SIDE, SLOW, child, prepare
from mvitac.cli.main import COMMANDS as ALL
from mvitac.cli.main import main as mvitac

READING = {
    "demo": "demo --recipe smoke --steps 1 --out {out}/d",
    "data pack grasps": f"data pack --data grasps --num 4 --size {SIDE} --workers 1 --quiet --out {{out}}/g",
    "data info": "data info {base}/pack",
    "data check": "data check {base}/pack",
    "data check --data": "data check --data folder --path {base}/table --workers 1",
    "live": "live {base}/export --vision {base}/table@99 --touch {base}/table@99 --seconds 1",
    "find": "find {base}/table/touch0.png --model {base}/run --known {base}/e.parquet --from touch --to touch",
    "pretrain mix": "pretrain --recipe smoke --data mix --data.parts a={base}/pack:1 b={base}/pack:2 --augment.size 16"
    " --steps 2 --batch-size 8 --eval-every 0 --quiet --out {out}/m",
    "bench board": "bench board {base}/result.json --out {out}/board.html",
    "bench check": "bench check {base}/result.json",
}
COMMANDS = {**WRITING, **READING}
"""One call of each command that works; ``base`` holds its inputs."""
MODULES = (*SLOW, "mvitac.deploy.export", "mvitac.deploy.search", "torch.onnx")
WORDS = [
    "nan",
    "inf",
    "-inf",
    "-1",
    "0",
    "0.5",
    "1e400",
    "99999999999999999999",
    "None",
    "[]",
    "null",
    "~nobody",
    "../x",
    "-",
    "--",
]
ODD = [
    *WORDS,
    "",
    " ",
    "ß→\u202e\x1b[31m",
    "\udcff",  # a byte that is not UTF-8, as Python shows it in sys.argv
    "a\nb",
    "a" * 300,
    "{base}/missing/file",
    "{base}/empty",
    "{base}/pack",
    "{base}/run",
    "{base}/table",
    "{base}/table/manifest.csv",
    "{base}/table/touch0.png",
    "http://127.0.0.1:9/x",
]


def options(words: list[str]) -> list[str]:
    """The options in the help of a command, which ``words`` begin, for the dataset, method and recipe that they choose."""
    with contextlib.redirect_stdout(io.StringIO()) as text, contextlib.suppress(SystemExit):
        mvitac([*words, "--help"])
    return sorted(set(re.findall(r"^[│| ]? {1,2}(--[\w.-]+)", text.getvalue(), re.MULTILINE)))


def without(words: list[str], option: str) -> list[str]:
    """``words`` without ``option`` and its value."""
    if option not in words:
        return words
    at = words.index(option)
    return words[:at] + words[at + 1 + (at + 1 < len(words) and not words[at + 1].startswith("--")) :]


def calls(name: str, base: Path, out: Path) -> list[list[str]]:
    """Every call that is generated for one command."""
    words = [word.format(base=base, out=out) for word in COMMANDS[name].split()]
    odd = [value.format(base=base) if "{base}" in value else value for value in ODD]
    made = [[*words, value] for value in odd]
    for option in options(words):
        rest = without(words, option)
        made += [rest, [*rest, option], [*rest, option, "1", option, "2"], [*words, f"{option[:-1]}"]]
        made += [[*rest, option, value] for value in odd] + [[*rest, f"{option}={value}"] for value in odd[::5]]
    for at, word in enumerate(words):
        if word.startswith(str(base)) and not words[at - 1].startswith("--"):
            made += [[*words[:at], value, *words[at + 1 :]] for value in odd]
    return made


def call(words: list[str], said: Path, limit: float) -> tuple[str, float]:
    """Run one call; returns how it ended (its exit code, "SIGNAL n" or "HANGS") and the seconds that it took."""
    begun = time.monotonic()
    if (process := os.fork()) == 0:
        code = 1
        try:
            os.setsid()
            signal.signal(signal.SIGINT, signal.default_int_handler)
            for at, path, flags in ((0, os.devnull, 0), (1, said, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)):
                os.dup2(os.open(path, flags), at)
            os.dup2(1, 2)
            pages = int(Path("/proc/self/statm").read_text().split()[0])
            for kind, most in ((resource.RLIMIT_AS, pages * 4096 + (4 << 30)), (resource.RLIMIT_FSIZE, 256 << 20)):
                resource.setrlimit(kind, (most, most))
            torch.set_num_threads(1)
            code = mvitac(words)
        except SystemExit as error:
            code = error.code if isinstance(error.code, int) else 1
        except BaseException:
            sys.excepthook(*sys.exc_info())
        finally:
            with contextlib.suppress(Exception):
                sys.stdout.flush()
            os._exit(code)
    sent, ended = 0, 0
    while not ended:
        ended, status = os.waitpid(process, os.WNOHANG)
        took = time.monotonic() - begun
        if not ended and took > limit + 10 * sent:
            if sent == 1:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(process, signal.SIGABRT)  # faulthandler prints where it hangs
            elif sent == 2:
                os.killpg(process, signal.SIGKILL)
            else:
                os.kill(process, signal.SIGINT)
            sent += 1
        time.sleep(0.002)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process, signal.SIGKILL)
    code = os.waitstatus_to_exitcode(status)
    return "HANGS" if sent > 1 else f"SIGNAL {-code}" if code < 0 else str(code), took


def wrong(ended: str, text: str) -> str:
    """Why a call failed; empty if it did not."""
    if "Traceback (most recent call last)" in text:
        return "traceback"
    if ended not in ("0", "1", "2", "130"):
        return ended
    if ended == "2" and not re.search(r"^mvitac: error: \S", text, re.MULTILINE) and "broken" not in text:
        return "2 without a line of error"
    return ""


def fuzz(chosen: list[list[str]], base: Path, limit: float) -> dict[str, Any]:
    """Run the calls, each in a fresh copy of ``base``."""
    master, said = base.with_name("master"), base.with_name("said")
    shutil.copytree(base, master)
    codes, failed, slow = Counter[str](), [], []
    for words in chosen:
        shutil.rmtree(base)
        shutil.copytree(master, base)
        os.chdir(base / "here")
        ended, took = call(words, said, limit)
        text = said.read_text(errors="replace")
        line = shlex.join(words).replace(str(base), "BASE").encode("utf-8", "backslashreplace").decode()
        codes[ended] += 1
        if why := wrong(ended, text):
            failed.append({"call": line, "why": why, "said": text[-1500:]})
            print(f"{why}: {line}", file=sys.stderr, flush=True)
        elif took > limit and words[0] != "live":
            slow.append(line)
    return {"calls": len(chosen), "codes": dict(codes), "interrupted": slow, "failed": failed}


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--commands", nargs="+", choices=COMMANDS, default=list(COMMANDS), metavar="COMMAND")
    parser.add_argument("--calls", type=int, default=1000, help="at most this many, evenly spread; 0 = all")
    parser.add_argument("--seed", type=int, default=0, help="which ones are drawn")
    parser.add_argument("--limit", type=float, default=20, help="seconds until a call gets SIGINT")
    chosen = parser.parse_args(argv)
    os.environ |= {"HF_HUB_OFFLINE": "1", "COLUMNS": "200", "NO_COLOR": "1"}
    for name in sorted({f"mvitac.cli.{place.split(':')[0]}" for place in ALL.values()} | set(MODULES)):
        importlib.import_module(name)
    with tempfile.TemporaryDirectory(prefix="mvitac-fuzz-") as folder:
        base = Path(folder) / "base"
        os.environ["MVITAC_CACHE"] = str(base / "cache")
        for path in (base, base / "here", base / "empty", out := base / "out"):
            path.mkdir()
        if child(lambda: prepare(base), said := Path(folder) / "said"):
            raise RuntimeError(said.read_text())
        for words in (
            f"export {base}/run --rows 4 --out {base}/export",
            f"embed {base}/pack --model {base}/run --out {base}/e.parquet",
            f"bench {base}/run --suite {base}/suite.toml --data-root {base} --out {base}/results",
        ):
            if child(lambda words=words: mvitac(words.split()), said):  # type: ignore[misc]
                raise RuntimeError(said.read_text())
        next((base / "results").glob("*.json")).rename(base / "result.json")
        made = [one for name in chosen.commands for one in calls(name, base, out)]
        rng, num = np.random.default_rng(chosen.seed), min(chosen.calls or len(made), len(made))
        picked = np.sort(rng.permutation(len(made))[:num])
        result = fuzz([made[i] for i in picked], base, chosen.limit)
        os.chdir("/")
    print(json.dumps({"could be generated": len(made), **result}, indent=1))
    return int(bool(result["failed"]))


if __name__ == "__main__":
    sys.exit(main())
