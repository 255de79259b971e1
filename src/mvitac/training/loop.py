"""Pre-training: the loop. Plain torch; each part has a file of its own, and ``setup.py`` prepares them.

All randomness is a function of (seed, step). A run that is killed at any time and resumed is therefore bit-identical to one
that was not interrupted (on the same machine, with the same number of threads).
"""

import math
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from types import FrameType

import torch

from mvitac.data.pack import Pack
from mvitac.model import Model
from mvitac.run import Run
from mvitac.system.distributed import join
from mvitac.system.locks import hold_lock
from mvitac.training import checkpoint
from mvitac.training.log import EARLY, Log, Logger
from mvitac.training.sampler import Batches, combine_seeds
from mvitac.training.setup import Setup, check_out, set_up
from mvitac.training.validation import Validation

MIN_BETWEEN_CHECKPOINTS = 10
"""Steps between checkpoints at least, unless ``checkpoint_every`` says otherwise: in short runs they took half the time."""


class Diverged(ValueError):
    """The loss or a weight is not finite."""


class Interrupted(Exception):
    """Training was stopped by Ctrl-C or SIGTERM, after a checkpoint was saved."""


def train(
    run: Run,
    out: str | Path,
    *,
    resume: bool = False,
    quiet: bool = False,
    loggers: tuple[Logger, ...] = (),
    pack: Pack | None = None,
    validate: bool = True,
) -> Path:
    """Pre-train and write the result into the folder ``out``, which is returned.

    The folder gets run.json (the settings), trained_on.safetensors (hashes of the rows it learns from), log.jsonl,
    checkpoint.pt (to resume from) and model.safetensors (the result). With ``eval_every``, model.best.safetensors has the
    weights that were best on split val. Until it is finished, checkpoint.previous.pt is the checkpoint before.

    Args:
        run: What to train, e.g. ``mvitac.recipe("quick")``.
        out: Folder of the run. It must be new or empty, unless ``resume`` is set.
        resume: Continue from the last checkpoint in ``out``, if there is one.
        loggers: Functions ``(step, values)`` that receive all logged values.
        pack: The data, if it is already open. Default: open it from ``run.data``.
        validate: Evaluate on held-out groups. It changes no weights.

    Raises:
        ValueError: If the settings are impossible; where possible, before the first step.
        Diverged: If the loss or a weight is not finite.
        Interrupted: After Ctrl-C or SIGTERM; a checkpoint, or after the last step the model, is saved.
        Busy: If another process trains in ``out``.

    Examples:
        >>> out = mvitac.train(mvitac.recipe("quick"), "runs/mine")  # doctest: +SKIP
        >>> model = mvitac.load(out)  # doctest: +SKIP
    """
    out = Path(out)
    check_out(out, resume)
    world = join()
    busy = f"{out} is being trained by another process: wait, or choose another --out"
    with hold_lock(out, busy, wait=False) if world.is_main else nullcontext():
        setup = set_up(run, out, world, quiet=quiet, pack=pack)
        if setup is not None:  # else the run is already finished
            with torch.random.fork_rng(devices=[]):  # keep the caller's random state
                _loop(setup, out, quiet=quiet, loggers=loggers, validate=validate)
    return out


def _loop(setup: Setup, out: Path, *, quiet: bool, loggers: tuple[Logger, ...], validate: bool) -> None:
    run, pack, world, method, step = setup.run, setup.pack, setup.world, setup.method, setup.step
    start, rows = setup.steps_done, len(setup.rows)
    num_steps, steps_per_epoch = run.num_steps(rows), run.steps_per_epoch(rows)
    save_every = run.checkpoint_every or max(MIN_BETWEEN_CHECKPOINTS, num_steps // 10)
    batches = setup.views.iterate(Batches(run, pack, setup.rows), start, num_steps)

    # Only rank 0 logs and evaluates; on the other processes ``log`` is None.
    made = Log(out, run, pack, start, num_steps, quiet=quiet, loggers=loggers) if world.is_main else None
    with made or nullcontext() as log, _stop_signals() as stop_requested:
        if log and not quiet:
            log.say(setup.hardware.sentence)
        validation = Validation(out, setup, log) if log and validate else None
        if validation and start == 0:
            validation(0)
        method.train()
        for at, chunks in enumerate(batches, start=start):
            done = at + 1  # number of steps, with this one
            last = done == num_steps

            # One optimiser step. The seed of dropout and the learning rate depend on the step number alone.
            lr = run.optim.rate(at, num_steps, at // steps_per_epoch)
            losses = step(chunks, lr=lr, seed=combine_seeds(run.seed, at) + 1, progress=done / num_steps)

            # Reading losses waits for the GPU: every log_every steps, and once early, so that the speed is known soon.
            report = last or done % run.log_every == 0 or done - start == EARLY < run.log_every
            if report:
                values = {name: float(value) for name, value in losses.items()}
                if not all(map(math.isfinite, values.values())):
                    told = ", ".join(f"{name} {value:.4g}" for name, value in values.items())
                    raise _diverged(f"the loss is not finite at step {done} ({told})", run)
                if log:
                    log.step(done, values, lr)

            # Stop after Ctrl-C or SIGTERM. Several processes must agree on the step, and ask each other when they report.
            stop = stop_requested() if world.size == 1 else report and world.any(stop_requested())
            save = last or done % save_every == 0 or stop
            evaluate = last or (run.eval_every > 0 and done % run.eval_every == 0)
            # Before weights are saved: a step may make them infinite although its own loss was finite.
            if (save or evaluate) and not torch.stack([each.isfinite().all() for each in method.parameters()]).all():
                raise _diverged(f"weights are not finite after step {done}", run)

            if log:
                log.advance(done)
                if evaluate and validation:
                    validation(done, last=last)

            if save and world.is_main:
                _check_still_there(out)
                checkpoint.save(out, run, method, step.optimiser, done, setup.validation_state)
            if stop and not last:
                raise Interrupted(f"stopped after step {done} of {num_steps}; {out} continues with resume")
    if world.is_main:
        Model(method, run, setup.spec, pack.size).save(out / "model.safetensors")
        _check_still_there(out)
        (out / checkpoint.PREVIOUS).unlink(missing_ok=True)
    if world.any(stop_requested()):  # since the last step was asked for; another training may follow
        raise Interrupted(f"stopped after step {num_steps} of {num_steps}; {out} is trained")


def _check_still_there(out: Path) -> None:
    if not (out / "run.json").exists():
        raise ValueError(f"{out / 'run.json'} is gone: {out} was deleted or moved during training, start again")


def _diverged(what: str, run: Run) -> Diverged:
    how = f"lower --optim.lr (now {run.optim.lr:g}; --lr of finetune), add --optim.warmup 0.05, or use --precision fp32"
    return Diverged(f"{what}: {how}; the last checkpoint is kept")


@contextmanager
def _stop_signals() -> Iterator[Callable[[], bool]]:
    """Turn SIGINT and SIGTERM into a request to stop after the current step. A second Ctrl-C stops at once."""
    received: set[int] = set()

    def request_stop(number: int, frame: FrameType | None) -> None:
        if number == signal.SIGINT and number in received:
            raise KeyboardInterrupt
        received.add(number)

    try:
        old = {number: signal.signal(number, request_stop) for number in (signal.SIGINT, signal.SIGTERM)}
    except ValueError:  # not in the main thread, where signals cannot be handled
        old = {}
    try:
        yield lambda: bool(received)
    finally:
        for number, handler in old.items():
            signal.signal(number, handler)
