"""Pre-training, top to bottom: batches, views, loss, step, log, checkpoint. Plain torch, each part in a file of its name.

Everything random is a function of (seed, step), so a run killed at any instant and resumed ends bit-identical to one that
was not (same machine, same number of threads).
"""

from __future__ import annotations

import math
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from types import FrameType

import torch

from mvitac.data.pack import Pack
from mvitac.methods.base import Method
from mvitac.model import Model, precision_of
from mvitac.nn.memory_bank import replicated, shard_banks
from mvitac.registry import to_json
from mvitac.run import Run, load_run
from mvitac.system.device import describe, describe_precision, pick_device, pick_precision
from mvitac.system.distributed import World, join, local_device, synchronise_norms
from mvitac.system.files import brief, check_place, write_json
from mvitac.system.locks import hold_lock
from mvitac.system.malloc import keep_freed_memory
from mvitac.system.provenance import provenance
from mvitac.training import checkpoint
from mvitac.training.log import EARLY, Log, Logger
from mvitac.training.sampler import mix, training_rows
from mvitac.training.step import Step
from mvitac.training.validation import evaluate
from mvitac.training.views import feed_parts, gel_mirror


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
    loggers: tuple[Logger, ...] = (),
    pack: Pack | None = None,
) -> Path:
    """Pre-train ``run`` into the folder ``out`` and return it.

    Leaves run.json, log.jsonl, checkpoint.pt (resumable) and model.safetensors (what to probe). ``resume`` continues
    from the checkpoint if there is one. ValueError for anything impossible, before the first step where it can be told; Busy
    if another process trains there.
    """
    out = Path(out)
    _check_out(out, resume)
    world = join()
    busy = f"{out} is being trained by another process: let it end, or choose another --out"
    with hold_lock(out, busy, wait=False) if world.writes else nullcontext():
        return _train(run, out, world, resume=resume, quiet=quiet, loggers=loggers, pack=pack)


def _train(
    asked: Run, out: Path, world: World, *, resume: bool, quiet: bool, loggers: tuple[Logger, ...], pack: Pack | None
) -> Path:
    """``train`` for the one process that does, and its ranks."""
    device = pick_device(local_device(asked.device))
    run = replace(asked, precision=_precision(asked, device, world))
    if world.rank:
        world.wait()  # rank 0 simulates or packs what is not there yet, the others find it
    pack = pack or run.data.open(quiet=quiet or not world.writes)
    if not world.rank:
        world.wait()
    rows = training_rows(run, pack)
    run.check(pack.spec, len(rows), pack.size)
    mirror = gel_mirror(run, pack, device)
    _check_world(run, world)
    again = (out / "run.json").exists()
    if again:
        begun = check_same(asked, pack, out)
        if (out / "model.safetensors").exists():
            return out  # resumed after its end
        _check_begun(begun, asked, run, out)

    if device.type == "cpu":
        keep_freed_memory()
    torch.manual_seed(run.seed)
    method = run.method.build(pack.spec, run.encoder)
    method.prepare(torch.from_numpy(rows))
    shard_banks(method, world)
    method.to(device).to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
    _try(method, run, pack)
    synchronise_norms(method, world)
    step = Step(run, method, device, world)
    num_steps, start = run.num_steps(len(rows)), 0
    if (out / "checkpoint.pt").exists():
        start = checkpoint.restore(out / "checkpoint.pt", run, method, step.optimiser, num_steps)
    world.same_everywhere(replicated(method))  # and no one writes before all have looked
    if not again and world.writes:
        record = {"run": to_json(asked), "pack": pack.digest, "num_pairs": pack.num, "data": to_json(pack.spec)}
        here = {"device": describe(device), "precision": run.precision}
        write_json(out / "run.json", {**record, **here, **provenance()})
    every = run.checkpoint_every or max(1, num_steps // 10)
    method.train()

    telling = {"quiet": quiet, "loggers": loggers}
    log_here = Log(out, start, num_steps, run.batch_size, **telling) if world.writes else nullcontext()
    with log_here as log, _stop_signals() as stopped:
        if log and not quiet:  # not measured for nobody
            log.say(describe_precision(asked.precision, run.precision, device))
        for at, parts in enumerate(
            feed_parts(run, pack, rows, method.views, device, world, start, num_steps, mirror), start=start
        ):
            rate = run.optim.rate(at, num_steps, at // run.steps_per_epoch(len(rows)))
            losses = step(parts, lr=rate, seed=mix(run.seed, at) + 1, progress=(at + 1) / num_steps)

            done = at + 1
            early = done - start == EARLY < run.log_every
            report = done % run.log_every == 0 or done == num_steps or early
            if report:
                values = {name: float(value) for name, value in losses.items()}  # the only place that waits for a GPU
                _check_finite(values, done, run)
                if log:
                    log.step(done, values, rate)
            stopping = stopped() if world.size == 1 else report and world.anyone(stopped())
            saving = done == num_steps or done % every == 0 or stopping
            if saving:
                _check_weights(method, done, run)
            if log:
                log.advance(done)
                if done == num_steps or (run.eval_every and done % run.eval_every == 0):
                    log.evaluation(done, evaluate(Model(method, run, pack.spec, pack.size), pack, run))
                    method.train()
            if saving:
                checkpoint.save(out / "checkpoint.pt", run, method, step.optimiser, done, world)
            if stopping and done < num_steps:
                raise Interrupted(f"stopped after step {done} of {num_steps}; continue with --resume --out {out}")
    if world.writes:
        Model(method, run, pack.spec, pack.size).save(out / "model.safetensors")
    world.wait()
    return out


def _check_finite(values: dict[str, float], step: int, run: Run) -> None:
    if not all(math.isfinite(value) for value in values.values()):
        parts = ", ".join(f"{name} {value:.4g}" for name, value in values.items())
        raise _diverged(f"the loss is not finite at step {step} ({parts})", run)


def _check_weights(method: Method, step: int, run: Run) -> None:
    """Before they are kept: a step may leave weights that are no numbers while its own loss still was one."""
    if not torch.stack([weights.isfinite().all() for weights in method.parameters()]).all():
        raise _diverged(f"weights are not finite after step {step}", run)


def _diverged(what: str, run: Run) -> Diverged:
    return Diverged(
        f"{what}: lower --optim.lr (now {run.optim.lr:g}), add --optim.warmup 0.05, or use --precision fp32; the last"
        " checkpoint is kept"
    )


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


def _precision(run: Run, device: torch.device, world: World) -> str:
    """``run.precision`` on ``device``; auto is bf16 only where every process has it."""
    precision = pick_precision(run.precision, device)
    return "fp32" if run.precision == "auto" and world.anyone(precision == "fp32") else precision


def check_same(run: Run, pack: Pack, out: Path) -> str:
    """The precision in which ``out`` was begun; ValueError unless it is that of ``run`` on ``pack``, where auto is any."""
    old, record = load_run(out)
    begun = precision_of(old, record)
    same = replace(run, precision=begun) if run.precision == "auto" else run
    if replace(old, precision=begun).digest() != same.digest() or record.get("pack") != pack.digest:
        raise ValueError(f"{out} holds a different run (other settings or data): give the same ones, or another --out")
    return begun


def _check_begun(begun: str, asked: Run, run: Run, out: Path) -> None:
    """Refuse to go on in another precision than the run in ``out`` was ``begun`` in: the weights would be no run's."""
    if begun != run.precision:
        raise ValueError(
            f"{out} was begun in {begun}, and --precision {asked.precision} means {run.precision} on this machine:"
            f" continue it with --precision {begun}, or delete it to start over in {run.precision}"
        )


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
                f"trunk {run.encoder.trunk} cannot see images of {run.augment.eval_size} px ({brief(error)}):"
                " give another --augment.size or --encoder.trunk"
            ) from None


@contextmanager
def _stop_signals() -> Iterator[Callable[[], bool]]:
    """Turn SIGINT and SIGTERM into a request to stop after the step; a second Ctrl-C stops at once."""
    asked: set[int] = set()

    def ask(number: int, frame: FrameType | None) -> None:
        if number == signal.SIGINT and number in asked:
            raise KeyboardInterrupt
        asked.add(number)

    try:
        old = {number: signal.signal(number, ask) for number in (signal.SIGINT, signal.SIGTERM)}
    except ValueError:  # not in the main thread: the caller's business
        old = {}
    try:
        yield lambda: bool(asked)
    finally:
        for number, handler in old.items():
            signal.signal(number, handler)
