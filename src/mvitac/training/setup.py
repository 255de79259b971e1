"""What happens before the first step, in the order of ``set_up``: data, precision, method, checkpoint, locked features."""

import math
import sys
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from mvitac.data.pack import Pack
from mvitac.data.spec import DataSpec
from mvitac.data.windows import places, recordings
from mvitac.datasets.base import DatasetConfig
from mvitac.evaluation import leaks
from mvitac.evaluation.features import features
from mvitac.evaluation.sensors import sensors_of
from mvitac.methods.base import Method
from mvitac.model import Model, load
from mvitac.nn.encoders import IMAGENET, SCRATCH, Seeded, build_trunk
from mvitac.nn.imagenet import source
from mvitac.registry import from_json, to_json
from mvitac.run import Run, load_run, precision_of
from mvitac.system.device import Hardware, describe, has_bf16, pick_device
from mvitac.system.distributed import World, join, local_device
from mvitac.system.files import brief, check_place, is_temporary, write_json
from mvitac.system.malloc import keep_freed_memory
from mvitac.system.progress import shown
from mvitac.system.provenance import provenance
from mvitac.training import checkpoint
from mvitac.training.sampler import check_mix
from mvitac.training.start import Start, load_start, read_start, warning
from mvitac.training.start import describe as describe_start
from mvitac.training.step import Step
from mvitac.training.views import StepViews, values_of

T = TypeVar("T")
DIFFERENT = "holds a different run (other settings or data): give the same ones, or another --out"


@dataclass(frozen=True)
class Setup:
    run: Run  # with ``precision`` resolved for this machine
    pack: Pack
    rows: np.ndarray  # pack rows to train on
    hardware: Hardware
    world: World
    method: Method
    views: StepViews
    step: Step
    steps_done: int  # by the checkpoint
    validation_state: dict[str, Any]  # of ``Validation``
    spec: DataSpec  # that of ``pack``, with the sensors that the model met


def set_up(asked: Run, out: Path, world: World, *, quiet: bool, pack: Pack | None) -> Setup | None:
    """Open the data, build the method, restore a checkpoint, and write run.json; None if the run is finished."""
    asked, device = check_start(asked, out)
    pack = open_pack(asked.data, world, quiet) if pack is None else pack
    if asked.positives_within:
        list(recordings(pack, places(pack, pack.spec.window)[1]))  # ValueError if the distance of two rows is not known
    rows = asked.method.training_rows(pack)
    asked.check(pack.spec, len(rows), pack.size)
    check_divisible(asked, world)
    check_mix(asked, pack, rows, world)
    resumed = (out / "run.json").exists()
    hardware = hardware_of(asked, pack, out if resumed else None)
    run = replace(asked, precision=hardware.precision)
    if resumed and _is_finished(asked, pack, out, world):
        return None

    start = read_start(run.init)
    method, taken = _build_method(run, pack, rows, device, start)
    if run.positives_within and method.views == 1 and run.positives != "same-touch-pairs":
        how = "one view of each image: choose --positives same-touch-pairs"
        raise ValueError(f"positives_within has no effect on method {run.method.name}, {how}")
    step = Step(run, method, device, world)
    done, validation = checkpoint.restore(out, run, method, step.optimiser, run.num_steps(len(rows)), world)
    with nullcontext() if quiet or not world.is_main else shown():
        locked = _locked_features(run, pack, method, world)
    views = StepViews(run, pack, method.views, device, world, locked)
    before = start.model.spec.sensors if start and "touch" in taken["taken"] else ()
    spec = replace(pack.spec, sensors=tuple(sorted({*sensors_of(pack, rows), *before})))
    setup = Setup(run, pack, rows, hardware, world, method, views, step, done, validation, spec)
    world.broadcast([*method.parameters(), *method.buffers()])
    world.barrier()  # rank 0 writes run.json only after all processes have looked for it
    if world.is_main:
        _record(setup, asked, out, start, taken, quiet=quiet)
    return setup


def check_start(asked: Run, out: Path) -> tuple[Run, torch.device]:
    """The run with the digest of its start weights, and its device; ValueError if a word of it or a file is wrong."""
    from_json(Run, to_json(asked))  # as whoever opens the finished run does
    for file in leaks.weights_files(asked) if not (out / "run.json").exists() else ():
        if not file.is_file():
            raise ValueError(f"weights {str(file)!r}: give imagenet, scratch, or a file that exists")
    return replace(asked, init=asked.init.resolved()), pick_device(local_device(asked.device))


def _record(setup: Setup, asked: Run, out: Path, start: Start | None, taken: dict[str, Any], *, quiet: bool) -> None:
    """Write run.json and the hashes of the rows that the run learns from, and say what it starts from."""
    run, pack, val = setup.run, setup.pack, setup.pack.rows("val")
    before = [*(start.sources if start else []), *map(leaks.file_source, leaks.weights_files(run))]
    own, *others = leaks.with_ancestors(leaks.source_of(pack, setup.rows), before)
    sources = [own, *([leaks.source_of(pack, val, leaks.CHOSE)] if len(val) else []), *others]
    learned = leaks.sources_digest(sources)
    if (out / "run.json").exists():
        if load_run(out)[1].get(leaks.LEARNED) != learned:
            raise ValueError(f"{out} {DIFFERENT}")
    else:
        record = {"run": to_json(asked), "pack": pack.digest, "num_pairs": pack.num, "data": to_json(setup.spec)}
        record |= {leaks.LEARNED: learned, "device": describe(setup.hardware.device), "precision": run.precision}
        record["bf16_slowdown"], said = setup.hardware.slowdown, []
        if used := [m for m in setup.method.encoders() if run.encoder[m].weights == IMAGENET]:
            record["imagenet"] = {m: source(run.encoder[m].trunk) for m in used}
            said += [f"{m} starts from ImageNet weights of {found}" for m, found in record["imagenet"].items()]
        if start:
            record["start"] = taken
            said.append(describe_start(taken))
        found = warning(run, start, before, pack)
        for line in [*(said if not quiet else ()), *([f"warning: {found}"] if found else ())]:
            print(f"mvitac: {line}", file=sys.stderr)
        write_json(out / "run.json", {**record, **provenance()}, sealed=True)
    if not (out / leaks.FILE).exists():
        leaks.write_sources(out, sources)


def check_out(out: Path, resume: bool) -> None:
    """Raise ValueError if ``out`` cannot become the folder of the run. Called before any data is simulated or packed."""
    check_place(out)
    if (out / "run.json").exists():
        if not resume:
            raise ValueError(f"{out} already holds a run: continue it with --resume, or choose another --out")
    elif out.exists() and (not out.is_dir() or not all(map(is_temporary, out.iterdir()))):
        raise ValueError(f"{out} exists and is not a run: choose another --out")


def _is_finished(asked: Run, pack: Pack, out: Path, world: World) -> bool:
    """Whether the run in ``out`` has its model. A damaged one is made again from the checkpoint."""
    check_same(asked, pack, out)
    if not (out / "model.safetensors").exists():
        return False
    try:
        load(out)
    except ValueError as error:
        if not (out / checkpoint.CHECKPOINT).exists():
            raise ValueError(f"{error} (its checkpoint is gone: delete {out} to train again)") from None
        if world.is_main:
            print(f"mvitac: {error}; making it again from {out / checkpoint.CHECKPOINT}", file=sys.stderr)
        return False
    if world.is_main:
        (out / checkpoint.PREVIOUS).unlink(missing_ok=True)  # left by a process that was killed at the very end
    return True


def check_divisible(run: Run, world: World) -> None:
    """Raise ValueError unless each process gets the same number of whole chunks of a batch."""
    multiple = world.size * max(1, run.chunk)
    if run.batch_size % multiple:
        given = f"batch_size {run.batch_size} is not divisible by {world.size} processes"
        raise ValueError(f"{given}{f' x chunk {run.chunk}' if run.chunk else ''}: give a multiple of {multiple}")


def check_same(run: Run, pack: Pack, out: Path) -> None:
    """Raise ValueError unless the run in folder ``out`` is ``run`` on ``pack``. Precision auto matches any precision."""
    old, record = load_run(out)
    begun = precision_of(old, record)
    same = replace(run, precision=begun) if run.precision == "auto" else run
    if replace(old, precision=begun).digest() != same.digest() or record.get("pack") != pack.digest:
        raise ValueError(f"{out} {DIFFERENT}")


def hardware_of(run: Run, pack: Pack, begun: Path | None) -> Hardware:
    """Device and precision of ``run``. A run that was ``begun`` goes on in its own; auto is bf16 if all agree."""
    device = pick_device(local_device(run.device))
    if run.precision != "auto":
        return Hardware.choose(device, run.precision)
    if begun:
        return Hardware.choose(device, precision_of(*load_run(begun)))
    measured = device.type == "cpu" and has_bf16(device)
    made = Hardware.choose(device, "auto", _trial_pass(run, pack, device) if measured else None)
    slow = join().any(made.precision == "fp32") and made.precision == "bf16"
    return Hardware.choose(device, "fp32") if slow else made


def _trial_pass(run: Run, pack: Pack, device: torch.device) -> Callable[[], None]:
    """One pass, forward and backward, of the trunks of a step with random weights, on some images of its size."""
    networks, spec = [], pack.spec
    with torch.random.fork_rng(devices=[]):
        for m in [m for m in spec.modalities if not _once(run, m)] or spec.modalities:
            trunk = build_trunk(replace(run.encoder[m], weights=SCRATCH), spec.channels(m), spec.frames(m)).to(device)
            size = run.augment.size_of(m)
            num = max(8, min(run.batch_size, 150_000 // size**2))  # few small images take other kernels than a batch
            images = torch.rand(num, spec.channels(m), size, size, device=device)
            trunk.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
            networks.append((trunk, images.to(memory_format=torch.channels_last)))

    def work() -> None:
        for trunk, images in networks:
            features = trunk(images)
            if features.requires_grad:
                features.float().sum().backward()

    return work


def open_pack(data: DatasetConfig, world: World, quiet: bool) -> Pack:
    """Open ``data``; rank 0 simulates or packs what does not exist yet."""
    return _main_process_first(lambda: data.open(quiet=quiet or not world.is_main), world)


def _main_process_first(read: Callable[[], T], world: World) -> T:
    """What ``read`` returns. Rank 0 computes what is not in the cache yet, then the others read it."""
    if world.rank:
        world.barrier()
    found = read()
    if not world.rank:
        world.barrier()
    return found


def _build_method(
    run: Run, pack: Pack, rows: np.ndarray, device: torch.device, start: Start | None
) -> tuple[Method, dict[str, Any]]:
    """The method of ``run`` with fresh or start weights, on ``device``, and what was taken of ``start``."""
    if device.type == "cpu":
        keep_freed_memory()
    with Seeded(run.seed):
        method = run.method.build(pack.spec, run.encoder)
        taken = load_start(start, method) if start else {}
        method.prepare(torch.from_numpy(rows))
    method.learn_scale(values_of(run, pack, rows))
    method.to(device).to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
    _check_trunks(method, run, pack)
    return method, taken


def _once(run: Run, modality: str) -> bool:
    """Whether features of ``modality`` are computed once: by a locked trunk, of images that do not vary."""
    return run.encoder[modality].locked and run.augment.of(modality).fixed and not run.method.needs_vit


def _locked_features(run: Run, pack: Pack, method: Method, world: World) -> dict[str, Tensor]:
    """Modality -> features [pack.num, D] of locked trunks, of whole images, from the cache that probes read, too."""
    model, found = Model(method, run, pack.spec, pack.size), {}
    for m, trunk in method.encoders().items():
        if _once(run, m):
            rows = np.flatnonzero(pack.has(m))
            known = torch.from_numpy(_main_process_first(lambda m=m, rows=rows: features(model, pack, m, rows), world))
            found[m] = torch.zeros(pack.num, known.shape[1]).index_put((torch.from_numpy(rows),), known)
            found[m] = found[m].to(next(trunk.parameters()).device)
    return found


def _check_trunks(method: Method, run: Run, pack: Pack) -> None:
    """Pass two images through each trunk: not every one supports every size, or has weights that give finite numbers."""
    model = Model(method, run, pack.spec, pack.size)
    for modality, trunk in model.encoders.items():
        shape, device = (2, pack.spec.channels(modality), pack.size, pack.size), next(trunk.parameters()).device
        images = (torch.arange(math.prod(shape), device=device) % 256).to(torch.uint8).view(shape)
        what = f"trunk {run.encoder[modality].trunk}"
        try:
            finite = model.features(modality, images).isfinite().all()
        except Exception as error:  # the type differs between trunks
            given = f"{what} cannot take images of {model.image_sizes(modality)[0]} px ({brief(error)})"
            raise ValueError(f"{given}: give another --augment.size or --encoder.trunk") from None
        if not finite:
            raise ValueError(f"{what} of {modality} gives NaN or infinite features: start from other weights")
