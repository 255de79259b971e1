"""Speed of training, input and probe, compared with the bare networks and with typical research code.

    python -m benchmarks.speed [--quick] [--device cpu|cuda] [--json FILE]     (make bench)

Sections: the step on random tensors in memory, the same compiled (on a GPU), the input, both together (end to end), the
probe, and gradient caching. Variants are interleaved and medians are compared. A step is compared with the bare
networks in the same precision (`benchmarks/floor.py`), with the measured peak arithmetic of the machine, with typical
research code (`benchmarks/typical.py`) and, if lightly is installed, with a step built from its components
(`benchmarks/lightly_parts.py`).

For several GPUs: torchrun --nproc-per-node N -m benchmarks.scaling
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import torch
from PIL import Image
from tabulate import tabulate

from benchmarks import lightly_parts
from benchmarks.floor import Floor, clock, peak
from benchmarks.typical import TypicalStep, typical_batches, write_jpegs
from mvitac.data.build import build
from mvitac.data.pack import Pack
from mvitac.data.source import Sample, Source
from mvitac.data.spec import DataSpec
from mvitac.evaluation.classifiers import EPOCHS, train_heads
from mvitac.evaluation.features import pack_features
from mvitac.methods.base import Views
from mvitac.model import Model
from mvitac.nn.encoders import SCRATCH, Encoders
from mvitac.recipes import recipe
from mvitac.run import Run
from mvitac.system.device import describe
from mvitac.system.files import brief, write_json
from mvitac.system.malloc import keep_freed_memory
from mvitac.system.provenance import provenance
from mvitac.training.sampler import Batches
from mvitac.training.step import Step
from mvitac.training.views import StepViews
from mvitac.transforms import random_views
from mvitac.transforms.random_views import ViewAugment, draw

PAPER_PAIRS, PAPER_EPOCHS = 91_982, 240
SECTIONS = ("step", "compiled", "input", "whole", "probe", "caching")


@dataclass(frozen=True, kw_only=True)
class Scale:
    """Size of the measurement. ``size`` is the side of a view in pixels, ``batch`` is in pairs."""

    trunk: str = "resnet18"
    size: int = 224
    batch: int = 32
    rounds: int = 5
    num_pairs: int = 128


class Jpegs(Source):
    """The JPEG files that the typical input reads, as a source to pack."""

    def __init__(self, folder: Path) -> None:
        self.paths = sorted(folder.glob("vision-*.jpg"))

    def spec(self) -> DataSpec:
        known = {"name": "jpegs", "vision_channels": 3, "touch_channels": 3, "tasks": (), "group_by": "file"}
        return DataSpec(**known, licence="none", source="benchmarks/speed.py")

    def items(self) -> list[str]:
        return [path.stem for path in self.paths]

    def fingerprint(self) -> dict[str, Any]:
        return {"num": len(self.paths)}

    def read(self, item: int) -> list[Sample]:
        path = self.paths[item]
        pair = [np.asarray(Image.open(p)) for p in (path, path.with_name(path.name.replace("vision", "touch")))]
        return [Sample(vision=pair[0], touch=pair[1], columns={"id": path.stem, "group": path.stem, "split": "train"})]


def interleave(
    variants: dict[str, Callable[[], object]],
    rounds: int,
    device: torch.device,
    lost: dict[str, str] | None = None,
) -> dict[str, float]:
    """Return the median seconds per call of each variant.

    Variants are called in turn, so that other load on the machine affects all of them. The value is NaN if a variant
    runs out of GPU memory or torch cannot compile it; the error is printed, and kept in ``lost`` by the variant's name.
    """
    lost = {} if lost is None else lost
    seconds: dict[str, list[float]] = {name: [] for name in variants}
    for turn in range(1 + rounds):  # the first call fills caches, prepares kernels and compiles
        for name, run in variants.items():
            if name in lost:
                continue
            try:
                value = clock(run, device)
            except RuntimeError as error:  # out of memory, not compiled, or not possible as a CUDA graph
                lost[name] = brief(error)
                print(f"{name}: {lost[name]}")
                torch.cuda.empty_cache()
                continue
            if turn:
                seconds[name].append(value)
    return {name: float("nan") if name in lost else median(values) for name, values in seconds.items()}


def steady(
    variants: dict[str, Callable[[], object]], workers: int, rounds: int, device: torch.device
) -> dict[str, float]:
    """Return the seconds per call of each variant that reads an input, by itself, over many calls.

    Inputs work ahead of the network, so after a pause a call would only take what is ready. The batches that were made
    ahead are used up before the clock starts.
    """
    seconds = {}
    for name, run in variants.items():
        ahead, num = (3 * workers, max(workers, rounds)) if "typical" in name else (4, 4 * rounds)
        for _ in range(ahead):
            run()
        seconds[name] = clock(lambda run=run, num=num: [run() for _ in range(num)], device) / num
    return seconds


def peak_memory(run: Callable[[], object], device: torch.device) -> dict[str, float]:
    """Return the additional GPU memory of one call in GiB (peak); {} on a CPU or out of memory."""
    if device.type != "cuda":
        return {}
    torch.cuda.synchronize(device)
    before = torch.cuda.memory_allocated(device)
    torch.cuda.reset_peak_memory_stats(device)
    try:
        run()
    except torch.OutOfMemoryError:
        return {}
    return {"peak_gib": (torch.cuda.max_memory_allocated(device) - before) / 2**30}


def known(rows: dict[str, dict[str, float]]) -> dict[str, dict[str, float]]:
    """Return ``rows`` without values that could not be measured (NaN)."""
    return {name: {key: value for key, value in row.items() if value == value} for name, row in rows.items()}


def our_run(scale: Scale, precision: str, **changes: Any) -> Run:
    """Return recipe `paper` at this scale, without pretrained weights."""
    base = recipe("paper")
    network = Encoders().changed(trunk=scale.trunk, weights=SCRATCH)
    optim = replace(base.optim, lr=1e-3)
    views = replace(base.augment, size=scale.size)
    return replace(
        base, encoder=network, optim=optim, augment=views, batch_size=scale.batch, precision=precision, **changes
    )  # type: ignore[arg-type]


def our_step(scale: Scale, precision: str, spec: DataSpec, device: torch.device, **changes: Any) -> Step:
    run = our_run(scale, precision, **changes)
    method = run.method.build(spec, run.encoder).to(device)
    method.to(memory_format=torch.channels_last)
    return Step(run, method.train(), device)


def typical_step(scale: Scale, device: torch.device) -> Callable[..., object]:
    """Return the typical step under torch's defaults: on a GPU, its fp32 convolutions round to TF32."""
    return with_cudnn(TypicalStep(scale.trunk, device), allow_tf32=True)


def measure_steps(scale: Scale, spec: DataSpec, device: torch.device, *, compiled: bool = False) -> dict[str, Any]:
    """Measure pairs/s of each step, and its share of the floor and of the measured peak in the same precision.

    ``compiled``: measure what may make the step in bf16 faster, instead of the other steps.
    """
    torch.manual_seed(0)
    images = [torch.randn(scale.batch, 3, scale.size, scale.size, device=device) for _ in range(4)]
    close = [image.contiguous(memory_format=torch.channels_last) for image in images]
    small = [image.bfloat16() for image in close]

    def ours(precision: str, mode: str | None = None, **changes: Any) -> Callable[[], object]:
        step = our_step(scale, precision, spec, device, **changes)
        if mode:
            step.forward = torch.compile(step.method, fullgraph=True, mode=mode)
        given = small if precision == "bf16" else close
        views = {"vision": [given[0], given[2]], "touch": [given[1], given[3]]}
        batch = Views(images=views, labels={}, rows=torch.arange(scale.batch, device=device))
        return lambda: step([lambda: batch], lr=1e-3, seed=0, progress=0.5)

    floors = {p: Floor(scale.trunk, device, p) for p in ("fp32", "bf16")}
    variants: dict[str, Callable[[], object]] = {"floor bf16": lambda: floors["bf16"](small), "ours bf16": ours("bf16")}
    graphs: dict[str, Callable[[], object]] = {}
    if compiled:
        # A graph keeps its memory, so that large batches of the others would no longer fit: it comes last.
        graphs["ours bf16 compiled, CUDA graphs"] = ours("bf16", mode="reduce-overhead")
        variants["ours bf16 compiled"] = ours("bf16", compile=True)
        variants["ours bf16, cuDNN tuned"] = with_cudnn(ours("bf16"), benchmark=True)
    else:
        typical = typical_step(scale, device)
        variants["typical fp32"] = lambda: typical((images[0], images[2]), (images[1], images[3]))
        variants |= {"floor fp32": lambda: floors["fp32"](close), "ours fp32": ours("fp32")}
    if lightly_parts.INSTALLED and not compiled:
        moco = lightly_parts.LightlyStep(scale.trunk, device)
        variants["lightly's parts, fp32"] = lambda: moco((images[0], images[2]), (images[1], images[3]))
    lost: dict[str, str] = {}
    seconds = interleave(variants, scale.rounds, device, lost)
    memory = {name: peak_memory(run, device) for name, run in variants.items() if name not in lost}
    seconds |= interleave(graphs, scale.rounds, device, lost)
    flop = floors["fp32"].flop([image[:8] for image in close]) * scale.batch // 8
    peaks = {p: peak(device, p) for p in ("fp32", "bf16")}
    rows = {}
    for name, value in seconds.items():
        precision = "bf16" if "bf16" in name else "fp32"
        rows[name] = {
            "pairs_per_s": scale.batch / value,
            "of_floor": seconds.get(f"floor {precision}", float("nan")) / value,
            "tflop_per_s": flop / value / 1e12,
            "of_matmul_peak": flop / value / peaks[precision]["matmul"],
            "of_conv_peak": flop / value / peaks[precision]["conv"],
            "over_typical": seconds.get("typical fp32", float("nan")) / value,
            **memory.get(name, {}),
        }
    return {"flop_per_pair": flop / scale.batch, "peak_flop_per_s": peaks, "variants": known(rows), "lost": lost}


def measure_input(scale: Scale, folder: Path, pack: Pack, device: torch.device, workers: int) -> dict[str, Any]:
    """Measure augmented images/s of each input without a network. On a CPU, also of views alone."""
    typical = typical_batches(folder, scale.size, scale.batch, workers)
    variants: dict[str, Callable[[], object]] = {"typical, JPEG files": lambda: next(typical)}
    images = torch.from_numpy(pack.images["vision"][np.resize(pack.rows("train"), scale.batch)]).permute(0, 3, 1, 2)
    drawn = draw(ViewAugment(), len(images), pack.size, torch.Generator().manual_seed(0))
    for name, dtype in (("fp32", torch.float32), ("bf16", torch.bfloat16)):
        parts = feed(our_run(scale, name), pack, device)
        ours: dict[str, Callable[[], object]] = {f"ours, pack, {name}": lambda f=parts: next(f)[0]()}
        if device.type == "cpu":
            ours[f"ours, views alone, {name}"] = lambda d=dtype: random_views.apply(images, drawn, scale.size, d)
        variants |= ours
    cuda = device.type == "cuda"
    seconds = steady(variants, workers, scale.rounds, device) if cuda else interleave(variants, scale.rounds, device)
    speeds = {n: (1 if "alone" in n else 4) * scale.batch / s for n, s in seconds.items()}  # a pair is four images
    return known({n: {"images_per_s": v, "over_typical": v / speeds["typical, JPEG files"]} for n, v in speeds.items()})


def with_cudnn(call: Callable[..., object], **flags: bool) -> Callable[..., object]:
    """Wrap ``call`` so that ``torch.backends.cudnn`` has these flags while it runs."""

    def put(values: dict[str, bool]) -> None:
        for name, value in values.items():
            setattr(torch.backends.cudnn, name, value)

    def wrapped(*given: object) -> object:
        before = {name: getattr(torch.backends.cudnn, name) for name in flags}
        try:
            put(flags)
            return call(*given)
        finally:
            put(before)

    return wrapped


def feed(run: Run, pack: Pack, device: torch.device) -> Any:
    """Yield the chunks of one step after another, as the training loop does, without end."""
    return StepViews(run, pack, 2, device).iterate(Batches(run, pack, pack.rows("train")), 0, 10**9)


def measure_whole(scale: Scale, folder: Path, pack: Pack, device: torch.device, workers: int) -> dict[str, Any]:
    """Measure pairs/s from stored data to updated weights, also as a share of the step alone."""
    loader, old = typical_batches(folder, scale.size, scale.batch, workers), typical_step(scale, device)

    def typical() -> None:
        a, b, c, d = (views.to(device) for views in next(loader))
        old((a, b), (c, d))

    step, parts = our_step(scale, "bf16", pack.spec, device), feed(our_run(scale, "bf16"), pack, device)
    alone = next(parts)[0]()
    variants = {
        "typical, JPEG files to weights": typical,
        "ours bf16, step alone": lambda: step([lambda: alone], lr=1e-3, seed=0, progress=0.5),
        "ours bf16, pack to weights": lambda: step(next(parts), lr=1e-3, seed=0, progress=0.5),
    }
    cuda = device.type == "cuda"
    seconds = steady(variants, workers, scale.rounds, device) if cuda else interleave(variants, scale.rounds, device)
    first, only = seconds["typical, JPEG files to weights"], seconds["ours bf16, step alone"]
    rows = {
        n: {"pairs_per_s": scale.batch / s, "over_typical": first / s, "of_step_alone": only / s}
        for n, s in seconds.items()
    }
    rows = known(rows)
    hours = PAPER_PAIRS * PAPER_EPOCHS * seconds["ours bf16, pack to weights"] / scale.batch / 3600
    return {"variants": rows, "hours_for_the_papers_pretraining": hours}


def measure_caching(scale: Scale, device: torch.device, plain: int, large: int, chunk: int) -> dict[str, Any]:
    """Measure peak memory and time per pair of a plain batch and of a large one in chunks, each in its own process."""
    rows = {}
    for name, batch, part in ((f"plain {plain}", plain, 0), (f"{large} in chunks of {chunk}", large, chunk)):
        settings = {"batch": batch, "chunk": part, "size": scale.size, "trunk": scale.trunk, "device": device.type}
        command = [sys.executable, "-m", "benchmarks.memory", json.dumps(settings)]
        rows[name] = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
    return rows


def measure_probe(scale: Scale, pack: Pack, device: torch.device, num: int = 5000) -> dict[str, Any]:
    """Measure the seconds of the paper's probe, 5 seeds x 3 tasks x 3 modalities, on ``num`` pairs.

    One variant computes features once and trains all heads together. The other encodes in every epoch for every head,
    as typical research code does; one pass is measured and multiplied.
    """
    seeds, classes = list(range(5)), [20, 2, 2]
    run = our_run(scale, "fp32")
    model = Model(run.method.build(pack.spec, run.encoder).to(device), run, pack.spec, pack.size)
    rows = pack.rows("train")[:64]

    def encode() -> None:
        for modality in pack.spec.modalities:
            pack_features(model, pack, modality, rows)

    encode()  # prepares the kernels
    one = clock(encode, device) * num / len(rows)
    labels = torch.stack([torch.randint(k, (num,)) for k in classes])
    heads = 0.0
    for width in (512, 512, 1024):
        features = torch.randn(num, width, device=device)
        heads += len(seeds) * clock(lambda f=features: train_heads(f, labels, classes, 0), device)  # type: ignore[misc]
    again = EPOCHS * one * len(seeds) * len(classes) * 2  # touch, vision, and both for each task of each seed
    once = one * len(seeds) + heads
    return {
        "encoding every epoch": {"seconds": again, "times": 1.0},
        "features once, heads together": {"seconds": once, "times": again / once},
        "of which the heads": {"seconds": heads},
    }


def show(title: str, rows: dict[str, dict[str, float]]) -> None:
    """Print ``rows`` as a table."""
    print(title, tabulate([{"": name, **row} for name, row in rows.items()], "keys", floatfmt=".3g"), "", sep="\n")


def measure(options: argparse.Namespace, scale: Scale, batches: list[int], save: Callable[[dict], object]) -> dict:
    """Run the sections that were asked for. ``save`` is called with all results after each."""
    device, workers = torch.device(options.device), options.workers
    result: dict[str, Any] = {
        "date": datetime.now(UTC).isoformat(timespec="minutes"),
        "device": describe(device),
        "load": os.getloadavg()[0],
        "scale": asdict(scale),
        **provenance(),
    }

    def keep(place: dict[str, Any], name: str, title: str, found: dict[str, Any]) -> None:
        place[name] = found
        show(title, found.get("variants", found))
        save(result)

    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        needs = {"input", "whole", "probe"} & set(options.sections)
        write_jpegs(folder / "jpegs", max(scale.num_pairs, *batches) if needs else 1)
        stored = round(scale.size * 8 / 7)  # 256 for 224 px; above 1.5 times, torch makes the views
        pack = build(Jpegs(folder / "jpegs"), folder / "pack", size=stored, quiet=True)
        given = folder / "jpegs", pack, device, workers
        for batch in batches:
            at = replace(scale, batch=batch)
            part = result.setdefault(f"batch {batch}", {})
            if "step" in options.sections:
                title = f"step, batch {batch}, {scale.size} px, {scale.trunk}"
                keep(part, "step", title, measure_steps(at, pack.spec, device))
            if "compiled" in options.sections and batch == batches[0]:  # takes minutes
                keep(part, "compiled", "compiled", measure_steps(at, pack.spec, device, compiled=True))
            if "input" in options.sections:
                keep(part, "input", "input", measure_input(at, *given))
            if "whole" in options.sections:
                keep(part, "whole", "end to end", measure_whole(at, *given))
                hours = part["whole"]["hours_for_the_papers_pretraining"]
                print(f"the paper's pre-training (92k pairs x 240 epochs) at this speed: {hours:.1f} h")
        if "probe" in options.sections:
            found = measure_probe(scale, pack, device, 500 if options.quick else 5000)
            keep(result, "probe", "the paper's probe: 5 seeds x 3 tasks x 3 modalities", found)
    if "caching" in options.sections:
        sizes = (16, 64, 8) if options.quick else (256, 4096, 256) if device.type == "cuda" else (64, 256, 32)
        keep(result, "caching", "gradient caching, bf16", measure_caching(scale, device, *sizes))
    print(f"{result['device']}, load {result['load']:.1f}, commit {result['commit']}")
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="small trunk at 64 px, under a minute")
    parser.add_argument("--trunk", help="another timm model, e.g. tf_efficientnet_lite0")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu", help="cpu or cuda")
    parser.add_argument(
        "--batch", type=int, nargs="+", help="pairs per batch; default 32 on a CPU, 256 and 1024 on a GPU"
    )
    parser.add_argument("--rounds", type=int, help="measurements per variant; default 5 on a CPU, 10 on a GPU")
    parser.add_argument(
        "--workers", type=int, help="processes of the typical DataLoader; default 0 on a CPU, up to 16 on a GPU"
    )
    parser.add_argument("--sections", nargs="+", choices=SECTIONS, help="default: all; on a CPU without compiled")
    parser.add_argument("--json", type=Path, help="write the results to this file, after each section")
    options = parser.parse_args()
    cuda = options.device.startswith("cuda")
    options.sections = options.sections or [s for s in SECTIONS if cuda or s != "compiled"]
    scale = Scale(rounds=10 if cuda else 5, num_pairs=512 if cuda else 128)
    if options.workers is None:
        options.workers = min(16, os.cpu_count() or 1) if cuda else 0
    if options.quick:
        scale = Scale(trunk="resnet10t", size=64, batch=16, rounds=3, num_pairs=32)
    scale = replace(scale, rounds=options.rounds or scale.rounds, trunk=options.trunk or scale.trunk)
    keep_freed_memory()
    batches = options.batch or ([256, 1024] if cuda and not options.quick else [scale.batch])
    measure(options, scale, batches, lambda result: options.json and write_json(options.json, result))


if __name__ == "__main__":
    main()
