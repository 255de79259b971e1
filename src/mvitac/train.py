"""Pre-training, top to bottom: batches, views, loss, step, log, checkpoint. Plain torch.

Everything random is a function of (seed, step), so a run killed at any instant and resumed ends bit-identical to one that
was not (same machine, same number of threads).
"""

from __future__ import annotations

import io
import json
import math
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import torch
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from torch import Tensor

from mvitac import diagnostics
from mvitac.allocator import keep_freed_memory
from mvitac.augment import random_view
from mvitac.batch import Views
from mvitac.distributed import World, join, local_device, synchronise_norms
from mvitac.feed import Feed, ahead
from mvitac.methods.base import Method
from mvitac.model import Model, load_run, pack_features
from mvitac.pack import Pack
from mvitac.record import brief, check_place, naming, provenance, write_atomic, write_json
from mvitac.registry import to_json
from mvitac.run import Run
from mvitac.step import Part, Step

Sink = Callable[[int, dict[str, float]], None]


class Diverged(ValueError):
    """The loss stopped being a number."""


class Interrupted(Exception):
    """Ctrl-C or SIGTERM, after the checkpoint was saved."""


def train(
    run: Run,
    out: str | Path,
    *,
    resume: bool = False,
    quiet: bool = False,
    sinks: tuple[Sink, ...] = (),
    pack: Pack | None = None,
) -> Path:
    """Pre-train ``run`` into the folder ``out`` and return it.

    Leaves run.json, log.jsonl, checkpoint.pt (resumable) and model.safetensors (what to probe). ``resume`` continues
    from the checkpoint if there is one. ValueError for anything impossible, before the first step where it can be told.
    """
    out = Path(out)
    _check_out(out, resume)
    world = join()
    device = pick_device(local_device(run.device))
    if world.rank:
        world.wait()  # rank 0 simulates or packs what is not there yet, the others find it
    pack = pack or run.data.open(quiet=quiet or not world.writes)
    if not world.rank:
        world.wait()
    rows = training_rows(run, pack)
    run.check(pack.spec, len(rows), pack.size)
    _check_world(run, world)
    again = (out / "run.json").exists()
    if again:
        _check_same(run, pack, out)
    if again and (out / "model.safetensors").exists():
        return out  # resumed after its end

    if device.type == "cpu":
        keep_freed_memory()
    torch.manual_seed(run.seed)
    method = run.method.build(pack.spec, run.encoder)
    method.prepare(torch.from_numpy(rows))
    method.to(device).to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
    _try(method, run, pack)
    synchronise_norms(method, world)
    step = Step(run, method, device, world)
    num_steps, start = run.num_steps(len(rows)), 0
    if (out / "checkpoint.pt").exists():
        start = _restore(out / "checkpoint.pt", run, method, step.optimiser, num_steps)
    world.same_everywhere([*method.parameters(), *method.buffers()])  # and no one writes before all have looked
    if not again and world.writes:
        record = {"run": to_json(run), "pack": pack.digest, "num_pairs": pack.num, "data": to_json(pack.spec)}
        write_json(out / "run.json", {**record, "device": describe(device), **provenance()})
    every = run.checkpoint_every or max(1, num_steps // 10)
    method.train()

    log_here = _Log(out, start, num_steps, quiet, sinks) if world.writes else nullcontext()
    with log_here as log, _stop_signals() as stopped:
        for at, parts in enumerate(
            feed_parts(run, pack, rows, method.views, device, world, start, num_steps), start=start
        ):
            rate = run.optim.rate(at, num_steps, at // run.steps_per_epoch(len(rows)))
            losses = step(parts, lr=rate, seed=mix(run.seed, at) + 1, progress=(at + 1) / num_steps)

            done = at + 1
            report = done % run.log_every == 0 or done == num_steps
            if report:
                values = {name: float(value) for name, value in losses.items()}  # the only place that waits for a GPU
                _check_finite(values, done, run)
                if log:
                    log.step(done, values, rate, run.batch_size)
            stopping = stopped() if world.size == 1 else report and world.anyone(stopped())
            if log is None:
                if stopping and done < num_steps:
                    raise Interrupted(f"stopped after step {done} of {num_steps}")
                continue
            log.advance(done)
            if done == num_steps or (run.eval_every and done % run.eval_every == 0):
                log.evaluation(done, evaluate(Model(method, run, pack.spec, pack.size), pack, run))
                method.train()
            if done == num_steps or done % every == 0 or stopping:
                state = {"method": method.state_dict(), "optimiser": step.optimiser.state_dict(), "step": done}
                buffer = io.BytesIO()  # written in one go: torch.save itself hides a full disk behind its own error
                torch.save({**state, "run": run.digest()}, buffer)
                write_atomic(out / "checkpoint.pt", lambda file, buffer=buffer: file.write(buffer.getbuffer()))
            if stopping and done < num_steps:
                raise Interrupted(f"stopped after step {done} of {num_steps}; continue with --resume --out {out}")
    if world.writes:
        Model(method, run, pack.spec, pack.size).save(out / "model.safetensors")
    world.wait()
    return out


def pick_device(name: str) -> torch.device:
    """The device of ``Run.device``; ValueError if it is not there."""
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
    except (RuntimeError, ValueError):
        raise ValueError(f"unknown device {name!r}: give auto, cpu, cuda or cuda:N") from None
    there = {"cpu": True, "cuda": True, "mps": torch.backends.mps.is_available()}
    if not there.get(device.type):
        raise ValueError(f"device {name!r} is not there or not supported: give auto, cpu, cuda or cuda:N")
    if device.type == "cuda" and (device.index or 0) >= torch.cuda.device_count():
        raise ValueError(
            f"device {name!r} is not there: torch sees {torch.cuda.device_count()} CUDA GPUs; use cpu or auto"
        )
    return device


def describe(device: torch.device) -> str:
    """The device for the record: a GPU by name, a CPU with its number of threads."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    return f"{device.type}, {torch.get_num_threads()} threads"


def training_rows(run: Run, pack: Pack) -> np.ndarray:
    """Pack rows to pre-train on; a method that learns from labels sees only rows that carry one it needs."""
    rows = pack.rows("train", "unlabelled", having=pack.spec.modalities)  # a pair with a hole in it is no pair
    tasks = run.method.labels_needed(pack.spec)
    if not tasks:
        return rows
    labels = {task: pack.labels(task)[rows] >= 0 for task in tasks}
    for task, there in labels.items():
        if not there.any():
            raise ValueError(f"task {task!r} has no labelled rows to train on: choose a self-supervised --method")
    return rows[np.logical_or.reduce(list(labels.values()))]


def mix(*numbers: int) -> int:
    """One 63-bit seed from several numbers, by numpy's SeedSequence."""
    return int(np.random.SeedSequence(numbers).generate_state(1, np.uint64)[0] >> 1)


def batches(run: Run, pack: Pack, rows: np.ndarray, start: int, num_steps: int) -> Iterator[np.ndarray]:
    """Pack rows of each step from ``start`` on; an epoch's order depends on (seed, epoch) alone."""
    per_epoch = run.steps_per_epoch(len(rows))
    touch_groups = pack.touch_groups[rows] if run.sampler == "one-per-touch" else None
    order, ordered_epoch = rows, -1
    for step in range(start, num_steps):
        epoch, place = divmod(step, per_epoch)
        if epoch != ordered_epoch:
            order, ordered_epoch = rows[epoch_order(len(rows), touch_groups, mix(run.seed, 1, epoch))], epoch
        yield order[place * run.batch_size : (place + 1) * run.batch_size]


def epoch_order(num: int, groups: np.ndarray | None, seed: int) -> np.ndarray:
    """A permutation of 0..num-1; with ``groups``, all first rows of every group come first, then all second ones, ...

    so that any stretch not longer than the number of groups holds hardly two rows of one group.
    """
    rng = np.random.default_rng(seed)
    order = rng.permutation(num)
    if groups is None:
        return order
    _, inverse, counts = np.unique(groups[order], return_inverse=True, return_counts=True)
    by_group = np.argsort(inverse, kind="stable")
    occurrence = np.empty(num, np.int64)
    occurrence[by_group] = np.arange(num) - np.repeat(np.cumsum(counts) - counts, counts)
    return order[np.argsort(occurrence, kind="stable")]


def feed_parts(
    run: Run,
    pack: Pack,
    rows: np.ndarray,
    num_views: int,
    device: torch.device,
    world: World,
    start: int,
    num_steps: int,
) -> Iterator[list[Part]]:
    """The parts of each step's batch that this process embeds: chunk by chunk of its own share of the rows.

    Views depend on (seed, step, part) alone, so two processes see what one process sees with a chunk of half the batch.
    """
    feed = Feed(pack, device)
    share = run.batch_size // world.size
    per_process = share // (run.chunk or share)
    num_parts = per_process * world.size

    def part(step: int, batch: np.ndarray, number: int) -> Views:
        seed = mix(run.seed, step) if num_parts == 1 else mix(run.seed, step, number)
        chunk = np.split(batch, num_parts)[number]
        return make_views(run, pack, chunk, num_views, torch.Generator().manual_seed(seed), device, feed)

    numbers = range(per_process * world.rank, per_process * (world.rank + 1))
    steps = enumerate(batches(run, pack, rows, start, num_steps), start=start)
    if device.type == "cuda" and per_process == 1:
        for made in ahead((part(step, batch, numbers[0]) for step, batch in steps), device):
            yield [partial(_same, made)]
        return
    for step, batch in steps:
        yield [partial(part, step, batch, number) for number in numbers]


def _same(views: Views) -> Views:
    return views


def make_views(
    run: Run,
    pack: Pack,
    rows: np.ndarray,
    num_views: int,
    generator: torch.Generator,
    device: torch.device,
    feed: Feed | None = None,
) -> Views:
    """Random views of the pack's ``rows`` on ``device``, in the precision the networks read them in."""
    feed = feed or Feed(pack, device)
    sources = [rows] * num_views
    if run.positives == "same-touch":
        sources[1:] = [partners(pack, rows, generator) for _ in range(num_views - 1)]
    dtype = torch.bfloat16 if run.precision == "bf16" else torch.float32
    images: dict[str, list[Tensor]] = {}
    for modality in pack.spec.modalities:
        config, images[modality] = getattr(run.augment, modality), []
        for source in sources:
            view = random_view(feed(modality, source), config, run.augment.size, generator, dtype)
            images[modality].append(view)
    labels = {t.name: torch.from_numpy(pack.labels(t.name)[rows]).to(device) for t in pack.spec.tasks}
    return Views(images=images, labels=labels, rows=torch.from_numpy(rows).to(device))


def partners(pack: Pack, rows: np.ndarray, generator: torch.Generator) -> np.ndarray:
    """For each of ``rows`` a random other row of its touch group in the same split, or itself if it is alone there."""
    groups, split = pack.touch_groups, pack.column("split")
    whole = np.logical_and.reduce([pack.has(modality) for modality in pack.spec.modalities])
    draws = torch.rand(len(rows), generator=generator).numpy()
    found = rows.copy()
    for i, row in enumerate(rows):
        others = pack.rows_of(int(groups[row]))
        others = others[(others != row) & (split[others] == split[row]) & whole[others]]
        if len(others):
            found[i] = others[int(draws[i] * len(others))]
    return found


def _check_finite(values: dict[str, float], step: int, run: Run) -> None:
    if all(math.isfinite(value) for value in values.values()):
        return
    parts = ", ".join(f"{name} {value:.4g}" for name, value in values.items())
    raise Diverged(
        f"the loss is not finite at step {step} ({parts}): lower --optim.lr (now {run.optim.lr:g}), add --optim.warmup 0.05,"
        " or use --precision fp32; the last checkpoint is kept"
    )


# -- while training: kNN and collapse panel ---------------------------------------------------------------------------

NUM_EVAL_TRAIN, NUM_EVAL_VAL = 1024, 512


@torch.no_grad()
def evaluate(model: Model, pack: Pack, run: Run) -> dict[str, float]:
    """kNN accuracy of each task and the collapse panel on held-out groups (split val); never looks at test.

    Without a val split the panel is over training rows and there is no kNN score. Only rows with both modalities count.
    """
    rng = np.random.default_rng(0)  # the same rows at every step and for every seed

    def some(rows: np.ndarray, num: int) -> np.ndarray:
        return np.sort(rng.choice(rows, min(num, len(rows)), replace=False))

    whole = pack.spec.modalities
    train_rows = some(pack.rows("train", "unlabelled", having=whole), NUM_EVAL_TRAIN)
    val_rows = pack.rows("val", having=whole)
    held_out = len(val_rows) > 1
    panel_rows = some(val_rows, NUM_EVAL_VAL) if held_out else train_rows[:NUM_EVAL_VAL]
    z = {m: pack_features(model, pack, m, panel_rows, precision=run.precision) for m in model.encoders}
    values: dict[str, float] = {}
    for modality, features in z.items():
        values[f"{modality}/std"] = diagnostics.spread(features)
        values[f"{modality}/rankme"] = diagnostics.rank_me(features)
    if held_out:
        bank = {m: pack_features(model, pack, m, train_rows, precision=run.precision) for m in model.encoders}
        for task in pack.spec.tasks:
            labels = torch.from_numpy(pack.labels(task.name))
            keep_bank, keep = labels[train_rows] >= 0, labels[panel_rows] >= 0
            if not (keep_bank.any() and keep.any()):
                continue
            for modality in z:
                values[f"{modality}/knn {task.name}"] = diagnostics.knn_accuracy(
                    bank[modality][keep_bank],
                    labels[train_rows][keep_bank],
                    z[modality][keep],
                    labels[panel_rows][keep],
                )
    if len(model.projectors) == 2:
        device = next(model.parameters()).device
        shared = {m: model.project(m, z[m].to(device)).cpu() for m in z}
        groups = torch.from_numpy(np.unique(pack.column("group")[panel_rows], return_inverse=True)[1])
        values["alignment"] = diagnostics.alignment(shared["vision"], shared["touch"])
        values["modality gap"] = diagnostics.modality_gap(shared["vision"], shared["touch"])
        for modality in shared:
            values[f"{modality}/uniformity"] = diagnostics.uniformity(shared[modality])
        for query, gallery in (("vision", "touch"), ("touch", "vision")):
            ranks = diagnostics.retrieval_ranks(shared[query], shared[gallery], groups)
            for name, value in diagnostics.recall_at(ranks, (1, 5)).items():
                values[f"{query}->{gallery} {name}"] = value
        values["chance R@5"] = min(1.0, 5 / (int(groups.max()) + 1))
    return values


# -- record, log, signals ---------------------------------------------------------------------------------------------


def _check_out(out: Path, resume: bool) -> None:
    """Refuse a folder that cannot become this run's, before any data is simulated or packed."""
    check_place(out)
    if (out / "run.json").exists():
        if not resume:
            raise ValueError(f"{out} already holds a run: continue it with --resume, or choose another --out")
    elif out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise ValueError(f"{out} exists and is not a run: choose another --out")


def _check_world(run: Run, world: World) -> None:
    if run.batch_size % (world.size * max(1, run.chunk)):
        raise ValueError(
            f"batch_size {run.batch_size} is not the same whole number of {'chunks' if run.chunk else 'pairs'} for each of"
            f" {world.size} processes: give a multiple of {world.size * max(1, run.chunk)}"
        )


def _check_same(run: Run, pack: Pack, out: Path) -> None:
    old, record = load_run(out)
    if old.digest() != run.digest() or record.get("pack") != pack.digest:
        raise ValueError(f"{out} holds a different run (other settings or data): give the same ones, or another --out")


@torch.no_grad()
def _try(method: Method, run: Run, pack: Pack) -> None:
    """Pass two blank images through every trunk: not every one takes every size. Nothing is learned from them."""
    model = Model(method, run, pack.spec, pack.size)
    for modality, trunk in model.encoders.items():
        device = next(trunk.parameters()).device
        blank = torch.zeros(2, pack.spec.channels(modality), pack.size, pack.size, dtype=torch.uint8, device=device)
        try:
            model.features(modality, blank)
        except Exception as error:  # each family of trunks has its own words for it
            raise ValueError(
                f"trunk {run.encoder.trunk} cannot see images of {run.augment.seen} px ({brief(error)}):"
                " give another --augment.size or --encoder.trunk"
            ) from None


def _restore(path: Path, run: Run, method: Method, optimiser: torch.optim.Optimizer, num_steps: int) -> int:
    """Load the checkpoint into ``method`` and ``optimiser`` and return its step; ValueError if it does not fit."""
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises several kinds for a damaged file
        raise ValueError(f"{path} is damaged ({brief(error)}): delete it to start over") from None
    for name, kind in (("method", dict), ("optimiser", dict), ("step", int)):
        if not isinstance(state, dict) or not isinstance(state.get(name), kind):
            raise ValueError(f"{path} is no checkpoint of mvitac ({name} is missing or odd): delete it to start over")
    if state.get("run", run.digest()) != run.digest():
        raise ValueError(f"{path} belongs to another run: put this run's own back, or delete it to start over")
    if not 0 <= state["step"] <= num_steps:
        raise ValueError(f"{path} was made at step {state['step']} of {num_steps}: delete it to start over")
    try:
        method.load_state_dict(state["method"])
        optimiser.load_state_dict(state["optimiser"])
    except Exception as error:  # other names, other shapes, other types
        raise ValueError(f"{path} does not fit this run ({brief(error)}): delete it to start over") from None
    return state["step"]


class _Log:
    """log.jsonl, the progress line, and the sinks; on resume, lines after the checkpoint are dropped."""

    def __init__(self, out: Path, start: int, num_steps: int, quiet: bool, sinks: tuple[Sink, ...]) -> None:
        path = out / "log.jsonl"
        kept = []
        if path.exists():
            for line in path.read_text(errors="replace").splitlines():
                try:
                    entry = json.loads(line)
                    early = entry["step"] <= start
                except (ValueError, TypeError, KeyError):
                    break  # the line that was being written when the run was killed
                if early:
                    kept.append(line + "\n")
        write_atomic(path, lambda file: file.write("".join(kept).encode()))
        self.path, self.file = path, path.open("a")
        self.sinks, self.start, self.since, self.since_step = sinks, start, time.perf_counter(), start
        columns = (TextColumn("{task.description}"), BarColumn(bar_width=16), MofNCompleteColumn())
        times = (TimeElapsedColumn(), TimeRemainingColumn(), TextColumn("{task.fields[text]}"))
        self.progress = Progress(*columns, *times, disable=quiet)
        self.bar = self.progress.add_task("pre-training", total=num_steps, completed=start, text="")

    def __enter__(self) -> _Log:
        self.progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.progress.stop()
        with naming(self.path):
            self.file.close()

    def step(self, step: int, losses: dict[str, float], lr: float, batch_size: int) -> None:
        now = time.perf_counter()
        speed = (step - self.since_step) * batch_size / max(1e-9, now - self.since)
        self.since, self.since_step = now, step
        self._write({"step": step, **losses, "lr": lr, "pairs_per_s": round(speed, 1)})
        text = " ".join(f"{name} {value:.2f}" for name, value in losses.items())
        self.progress.update(self.bar, text=f"{text}  {speed:.0f}/s")

    def advance(self, step: int) -> None:
        self.progress.update(self.bar, completed=step)

    def evaluation(self, step: int, values: dict[str, float]) -> None:
        self._write({"step": step, "eval": values})
        best = [f"{name} {value:.3f}" for name, value in values.items() if "knn" in name or name.endswith("R@5")]
        if not self.progress.disable:
            self.progress.console.print(f"step {step}: " + ", ".join(best), soft_wrap=True, highlight=False)

    def _write(self, entry: dict[str, Any]) -> None:
        with naming(self.path):
            self.file.write(json.dumps(entry) + "\n")
            self.file.flush()
        flat = {k: v for k, v in {**entry, **entry.get("eval", {})}.items() if isinstance(v, float)}
        for sink in self.sinks:
            sink(entry["step"], flat)


@contextmanager
def _stop_signals() -> Iterator[Callable[[], bool]]:
    """Turn the first SIGINT or SIGTERM into a request to stop after the step; a second Ctrl-C stops at once."""
    asked = False

    def ask(number: int, frame: FrameType | None) -> None:
        nonlocal asked
        if asked:
            raise KeyboardInterrupt
        asked = True

    try:
        old = {number: signal.signal(number, ask) for number in (signal.SIGINT, signal.SIGTERM)}
    except ValueError:  # not in the main thread: the caller's business
        old = {}
    try:
        yield lambda: asked
    finally:
        for number, handler in old.items():
            signal.signal(number, handler)
