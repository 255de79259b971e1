"""Kill commands between any two changes of the disk, and flip single bits of files: nothing may be lost or go unnoticed.

    python -m benchmarks.faults kills --points 25      # at most 25 kills per command, evenly spread; 0 = all
    python -m benchmarks.faults kills --commands pretrain publish
    python -m benchmarks.faults flips --num 100
    python -m benchmarks.faults kills flips            # both, on inputs that are made once

Kills. An audit hook (PEP 578) counts what a command does to the disk: files opened for writing, renames, deletions, new
folders. The process gets SIGKILL right before the n-th of these, and before the rename of a temporary file also with half
of it, as in the middle of a write. The same command is then given again. It must end well, or refuse because the result
is complete; and the folder must hold the files of an undisturbed run, no others, with the same content. All processes are
forked from one that has imported the library.

Flips. A file with one flipped bit must be refused or made again, or give exactly what the whole one gives.

The result is printed as JSON; the exit code is 1 if anything was lost or unnoticed.
"""

from __future__ import annotations

import argparse
import copy
import hashlib
import importlib
import io
import json
import os
import shutil
import signal
import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from contextlib import redirect_stderr
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.torch
import torch
from PIL import Image

from mvitac.cli.main import COMMANDS as ALL
from mvitac.cli.main import main as mvitac
from mvitac.data.pack import Pack
from mvitac.evaluation.features import features
from mvitac.evaluation.leaks import FILE, read_sources
from mvitac.model import load, safetensors_digest
from mvitac.run import load_run
from mvitac.system import files as system_files
from mvitac.system.files import read_json
from mvitac.training import checkpoint
from mvitac.training.step import Step

NUM, SIDE = 48, 16
TRAIN = "--recipe smoke --data pack --data.path {base}/pack --augment.size 16 --steps 3 --batch-size 8 --eval-every 0"
COMMANDS = {
    "data pack materials": f"data pack --data materials --num 40 --touches 1 --size {SIDE} --workers 1 --quiet"
    " --out {out}/p",
    "data pack": f"data pack --data folder --path {{base}}/table --size {SIDE} --workers 1 --quiet --out {{out}}/p",
    "pretrain": f"pretrain {TRAIN} --checkpoint-every 1 --resume --quiet --out {{out}}/r",
    "finetune": "finetune {base}/run --data pack --data.path {base}/pack --lr 1e-3 --steps 2 --batch-size 8 --quiet --resume"
    " --no-from-scratch --out {out}/f",
    "probe": "probe {base}/run --probes knn --no-controls --json {out}/scores.json",
    "compare": "compare --plan {base}/plan.json --out {out}/c",
    "publish": "publish {base}/run {out}/a",
    "export": "export {base}/run --rows 4 --out {out}/x",
    "embed": "embed {base}/pack --model {base}/run --out {out}/e.parquet",
    "report": "report {base}/run --out {out}/report --quiet",
    "bench": "bench {base}/run --suite {base}/suite.toml --data-root {base} --out {out}/b",
}
SUITE = f"""
name = "small"
title = "Made images"
probes = ["linear"]
seed = 0
untrained = ["external:timm/test_resnet,weights=random,size={SIDE},seed=0"]
imagenet = "external:timm/tf_efficientnet_lite0,size={SIDE}"
[[sets]]
name = "table"
tasks = [{{ name = "kind", modalities = ["touch"] }}]
forms = [{{ name = "pack", at = {{ path = "pack" }}, data = {{ name = "pack" }} }}]
"""
SLOW = ("torch._dynamo", "mvitac.evaluation.evaluate", "mvitac.training.loop")
"""Modules that are imported late."""
EVENTS = ("open", "os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.truncate", "os.link")


def prepare(base: Path) -> None:
    """Make the inputs of all commands: a table of images, a pack, a finished run and a plan."""
    rng = np.random.default_rng(0)
    (base / "table").mkdir()
    lines = ["vision,touch,kind,group"]
    for i in range(NUM):
        for name in ("vision", "touch"):
            image = rng.integers(0, 128, (SIDE, SIDE, 3), np.uint8) + np.uint8(60 * (i % 2))
            Image.fromarray(image).save(base / "table" / f"{name}{i}.png")
        lines.append(f"vision{i}.png,touch{i}.png,{'ab'[i % 2]},g{i // 2}")
    (base / "table" / "manifest.csv").write_text("\n".join(lines))
    for argv in (
        f"data pack --data folder --path {base}/table --labels kind --size {SIDE} --workers 1 --quiet --out {base}/pack",
        f"pretrain {TRAIN} --quiet --out {base}/run",
    ):
        if mvitac(argv.format(base=base).split()):
            raise RuntimeError(argv)
    row = {"label": "MViTac", "set": {"augment.size": SIDE, "batch_size": 8, "eval_every": 0, "steps": 2}}
    plan = {"name": "small", "rows": [row], "reference": "MViTac", "recipe": "smoke", "seeds": 1, "probes": ["knn"]}
    data = {"name": "pack", "path": str(base / "pack")}
    (base / "plan.json").write_text(json.dumps({**plan, "data": data}))
    (base / "suite.toml").write_text(SUITE)


def child(work: Callable[[], int | None], said: Path) -> int:
    """Run ``work`` in a forked process that prints into ``said``. Return its exit code, or -9 after SIGKILL."""
    if (process := os.fork()) == 0:
        code = 1
        try:
            file = os.open(said, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            os.dup2(file, 1)
            os.dup2(file, 2)
            torch.set_num_threads(1)
            code = work() or 0
        except BaseException:
            sys.excepthook(*sys.exc_info())
        finally:
            sys.stdout.flush()
            os._exit(code)
    return os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])


def kill_at(point: int, out: Path, count: Path | None = None) -> None:
    """Kill this process before change number ``point`` of files below ``out``; write the number of changes to ``count``."""
    done = 0

    def hook(event: str, args: tuple[Any, ...]) -> None:
        nonlocal done
        if event not in EVENTS or isinstance(args[0], int):
            return
        if event == "open" and not (args[2] or 0) & (os.O_WRONLY | os.O_RDWR | os.O_CREAT):
            return
        path = os.fsdecode(args[0])
        if not path.startswith(str(out)) and not (event in ("os.remove", "os.rmdir") and not os.path.isabs(path)):
            return  # rmtree names files relative to open folders
        torn = event == "os.rename" and path.endswith(".tmp")
        done += 1 + torn
        if count:
            count.write_text(str(done)) if str(count) != path else None
        elif done - torn <= point <= done:
            if torn and point < done:
                os.truncate(path, os.path.getsize(path) // 2)
            os.kill(os.getpid(), signal.SIGKILL)

    sys.addaudithook(hook)


def tree(folder: Path) -> dict[str, str]:
    """Every file below ``folder`` with a digest of what must be equal in it; temporary names would show here."""
    found = {}
    for path in sorted(folder.rglob("*")):
        name = str(path.relative_to(folder))
        if path.suffix in (".npy", ".npz", ".parquet", ".jpegs"):
            found[name] = hashlib.sha256(path.read_bytes()).hexdigest()
        elif path.suffix == ".safetensors":
            found[name] = safetensors_digest(safetensors.torch.load_file(path))
        elif path.suffix == ".pt":
            found[name] = str(torch.load(path, weights_only=True)["step"])
        elif path.suffix == ".jsonl":
            lines = [json.loads(line) for line in path.read_text().splitlines()]
            found[name] = str([(line["step"], line.get("loss")) for line in lines])
        else:
            found[name] = "whole" if path.is_dir() or path.stat().st_size else "empty"
        if path.suffix == ".json":
            json.loads(path.read_text())
    return found


def kills(base: Path, name: str, points: int) -> dict[str, Any]:
    """Kill one command at up to ``points`` places (0 = all), each time in an empty folder, and give it again."""
    out, said = base / "out", base / "said"
    words = [word.format(base=base, out=out) for word in COMMANDS[name].split()]

    def clear() -> None:
        shutil.rmtree(out, ignore_errors=True)
        out.mkdir()
        os.environ["MVITAC_CACHE"] = str(out / "cache")
        (base / "run" / "probe.json").unlink(missing_ok=True)

    def counted() -> int:
        kill_at(0, out, base / "count")
        return mvitac(words)

    clear()
    if child(counted, said):
        raise RuntimeError(f"{name}: {said.read_text()}")
    whole, num = tree(out), int((base / "count").read_text())
    chosen = range(1, num + 1) if not points else np.unique(np.linspace(1, num, min(points, num)).astype(int)).tolist()
    outcomes: Counter[str] = Counter()
    failed = []
    for point in chosen:
        clear()

        def struck(point: int = point) -> int:
            kill_at(point, out)
            return mvitac(words)

        if child(struck, said) != -signal.SIGKILL:
            outcomes["not killed"] += 1
            continue
        code = child(lambda: mvitac(words), said)
        try:
            differs = sorted(set(tree(out).items()) ^ set(whole.items()))
        except Exception as error:  # any: the file cannot be read
            differs = [("unreadable", str(error))]
        if code in (0, 2) and not differs and "Traceback" not in said.read_text():
            outcomes["finished" if code == 0 else "was complete"] += 1
        else:
            outcomes["LOST"] += 1
            failed.append({"point": point, "code": code, "differs": differs[:6], "said": said.read_text()[-600:]})
    return {"changes of the disk": num, **outcomes, "failed": failed}


def readers(base: Path) -> dict[str, tuple[list[Path], Callable[[], Any]]]:
    """What is flipped: name -> files, and a function that reads them and returns their content."""
    words = f"probe {base}/run --probes knn --no-controls --json {base}/scores.json".split()
    os.environ["MVITAC_CACHE"] = str(base / "probed")
    if child(lambda: mvitac(words), base / "said"):
        raise RuntimeError((base / "said").read_text())
    run, record = load_run(base / "run")
    probed = read_json(base / "scores.json", "scores")
    model, pack = load(base / "run"), Pack(base / "pack")
    method = run.method.build(pack.spec, run.encoder)
    os.environ["MVITAC_CACHE"] = str(base / "cache")
    rows = np.arange(NUM)
    known = features(model, pack, "touch", rows)
    cached = list((base / "cache").rglob("*.npy"))

    def resumed() -> Any:
        own = copy.deepcopy(method)
        optimiser = Step(run, own, torch.device("cpu")).optimiser
        with redirect_stderr(io.StringIO()):
            done, _ = checkpoint.restore(base / "run", run, own, optimiser, run.num_steps(NUM))
        state = optimiser.state_dict()
        moments = {f"{i} {name}": value for i, values in state["state"].items() for name, value in values.items()}
        return done, safetensors_digest(own.state_dict()), safetensors_digest(moments), state["param_groups"]

    def trained() -> Any:
        found = load(base / "run")
        return found.run, found.spec, found.stored, found.weights_digest()

    def packed() -> Any:
        found = Pack(base / "pack")
        images = {m: hashlib.sha256(np.ascontiguousarray(i).tobytes()).hexdigest() for m, i in found.images.items()}
        return found.spec, found.num, found.size, found.digest, found.table.to_pydict(), images

    def recorded() -> Any:
        found, scores = load_run(base / "run"), read_json(base / "run" / "probe.json", "scores")
        learned = [[s.name, s.ids.tolist(), s.groups.tolist()] for s in read_sources(base / "run") or ()]
        # An entry more is a flipped name of the digest itself, without which the file is read as it is.
        return found[0], [found[1][name] for name in record], [scores[name] for name in probed], learned

    def computed() -> Any:
        return np.array_equal(features(model, pack, "touch", rows), known)

    files = [base / "pack" / name for name in ("pack.json", "samples.parquet", "vision.npy", "touch.npy")]
    return {
        "checkpoint": ([base / "run" / checkpoint.CHECKPOINT], resumed),
        "model": ([base / "run" / "model.safetensors"], trained),
        "pack": (files, packed),
        "feature cache": (cached, computed),
        "records": ([base / "run" / name for name in ("run.json", "probe.json", FILE)], recorded),
    }


def flips(base: Path, num: int) -> dict[str, Any]:
    """Flip ``num`` single bits of each kind of file, one at a time, at random places."""
    rng, result = np.random.default_rng(0), {}
    for name, (files, read) in readers(base).items():
        good, outcomes = read(), Counter[str]()
        for i in range(num):
            path = files[i % len(files)]
            whole = path.read_bytes()
            bit = int(rng.integers(8 * len(whole)))
            damaged = bytearray(whole)
            damaged[bit // 8] ^= 1 << bit % 8
            path.write_bytes(damaged)
            try:
                same = read() == good
                outcomes["SILENT" if not same else "made again" if path.read_bytes() == whole else "same content"] += 1
            except ValueError:
                outcomes["refused"] += 1
            path.write_bytes(whole)
        result[name] = dict(outcomes)
    return result


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kinds", choices=("kills", "flips"), nargs="+", metavar="kills|flips")
    parser.add_argument("--commands", nargs="+", choices=COMMANDS, default=list(COMMANDS), metavar="COMMAND")
    parser.add_argument("--points", type=int, default=0, help="kills per command; 0 = before every change of the disk")
    parser.add_argument("--num", type=int, default=100, help="flips per kind of file")
    options = parser.parse_args(argv)
    system_files._STALE = -1  # what a kill leaves is removed at once, not after ten minutes
    if "kills" in options.kinds:
        modules = {ALL[" ".join(command.split()[:2])].split(":")[0] for command in options.commands}
        for name in (*(f"mvitac.cli.{module}" for module in modules), *SLOW):
            importlib.import_module(name)
    with tempfile.TemporaryDirectory(prefix="mvitac-faults-") as folder:
        base = Path(folder)
        if child(lambda: prepare(base), base / "said"):  # this process computes nothing, so that it can be forked
            raise RuntimeError((base / "said").read_text())
        result = {name: kills(base, name, options.points) for name in options.commands if "kills" in options.kinds}
        if "flips" in options.kinds:  # last: this process reads files from here on
            result |= flips(base, options.num)
    print(json.dumps(result, indent=1))
    return int(any("SILENT" in one or "LOST" in one for one in result.values()))


if __name__ == "__main__":
    sys.exit(main())
