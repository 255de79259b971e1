"""``Run``: every setting that decides the outcome of pre-training. It is stored with each result as run.json."""

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Fixed, arg

from mvitac.data.spec import DataSpec
from mvitac.datasets.base import DatasetConfig
from mvitac.methods.base import MethodConfig
from mvitac.methods.mvitac import MViTacConfig
from mvitac.nn.encoders import SCRATCH, EncoderConfig, Encoders
from mvitac.nn.initial import Init
from mvitac.nn.vit import check_vit
from mvitac.registry import check_range, from_json, to_json
from mvitac.system.files import digest, read_json
from mvitac.transforms.random_views import Augment, ViewAugment

MAX_STEPS = 100_000_000
"""More steps than this are taken for a typing error: at a thousand steps a second they would take a day."""
NOT_IN_DIGEST = ("device", "log_every", "eval_every", "checkpoint_every")
"""Fields of ``Run`` that say where it runs and how often it reports, and do not change the outcome."""


@dataclass(frozen=True, kw_only=True)
class Optim:
    """The optimiser and its learning-rate schedule."""

    name: Literal["adam", "adamw", "sgd"] = "adam"
    """Optimiser (paper: Adam). sgd has momentum .9."""
    lr: float = 0.03
    """Peak learning rate (paper: .03)."""
    eps: Fixed[float] = 1e-7
    """Epsilon of Adam (paper: 1e-7)."""
    weight_decay: float = 0.0
    """L2 penalty (adam, sgd) or decoupled weight decay (adamw). The paper gives none."""
    decay_norms: Fixed[bool] = True
    """Also decay biases and the parameters of normalisation layers. Current practice is not to."""
    schedule: Literal["constant", "cosine", "step", "late-step"] = "constant"
    """constant; cosine, to zero; step, x0.9 every 10 epochs from epoch 10 on; or late-step, the same from epoch 20 on (the
    authors' StepLR, which is stepped from epoch 10 on). The paper gives none."""
    warmup: float = 0.0
    """Fraction of the steps during which the learning rate rises linearly from zero."""

    def __post_init__(self) -> None:
        check_range(self, 1e-30, math.inf, "lr", "eps")
        check_range(self, 0, math.inf, "weight_decay")
        check_range(self, 0, 0.99, "warmup")

    def rate(self, step: int, num_steps: int, epoch: int) -> float:
        """Learning rate of step ``step`` (counted from 0) out of ``num_steps``."""
        warm = int(self.warmup * num_steps)
        if step < warm:
            return self.lr * (step + 1) / warm
        if self.schedule == "cosine":
            return self.lr * 0.5 * (1 + math.cos(math.pi * (step - warm) / max(1, num_steps - warm)))
        times = {"step": epoch // 10, "late-step": max(0, epoch // 10 - 1)}
        return self.lr * 0.9 ** times.get(self.schedule, 0)


@dataclass(frozen=True, kw_only=True)
class Run:
    """One pre-training run: method, data, encoder, augmentation, optimiser, budget and seed.

    ``data`` is required; the other defaults are the paper's. ``mvitac.recipe`` returns complete runs.

    Examples:
        >>> from dataclasses import replace
        >>> import mvitac
        >>> run = replace(mvitac.recipe("quick"), steps=100, seed=1)
        >>> run.method.name, run.batch_size
        ('mvitac', 32)
    """

    recipe: Fixed[str] = "paper"
    """Name of the recipe this run started from. For the record only."""
    method: MethodConfig = MViTacConfig()
    data: DatasetConfig
    encoder: Encoders = Encoders()
    init: Annotated[Init, arg(name="")] = Init()
    augment: Augment = Augment()
    optim: Optim = Optim()
    batch_size: int = 256
    """Pairs per step (paper: 256). Methods with in-batch negatives use the other pairs as negatives."""
    epochs: float = 240.0
    """Passes over the training rows (paper: 240)."""
    steps: int | None = None
    """Number of steps. If given, epochs is ignored."""
    sampler: Literal["shuffle", "one-per-touch", "spread"] = "shuffle"
    """Order of the rows. shuffle: random permutation (paper). The others keep near-duplicates from being negatives of each
    other: spread distributes the rows of a touch group over the whole epoch. one-per-touch takes one row of each group,
    then a second one, and so on, if all groups have the same size, and is the same as spread if not."""
    positives: Literal["same-image", "same-touch", "same-touch-pairs"] = "same-image"
    """Which image is the positive. same-image: another view of the same row (paper). same-touch: a view of another
    row of the same touch group: another press of the same instance in the simulator, another frame of the same contact in
    Touch and Go. Only between presses do lamp, background, sensor and position differ, so that they do not reveal the
    match. A row without others is its own partner. For one-view methods (ssvtp, cmc) both mean the vision and touch of one
    row. same-touch-pairs gives one-view methods the vision of one row and the touch of another."""
    positives_within: float = 0.0
    """Other rows are positives only up to this distance in time: K frames before or after, in units of the column that
    orders the frames of a touch (--data.order). 0 = any distance. Not for same-image."""
    precision: Literal["auto", "fp32", "tf32", "bf16"] = "fp32"
    """Arithmetic of the networks. Losses, weights and the optimiser stay in fp32. auto: bf16 where the hardware computes it
    (GPUs from Ampere; CPUs with AVX512-BF16 or AMX where half a second of the run's networks is faster in it), else fp32;
    run.json says which. fp32 never uses TF32. tf32 lets a GPU
    round products to 10 bits."""
    chunk: int = 0
    """Pairs that are embedded at a time (gradient caching). A batch of any size then needs the memory of one chunk, for
    about a quarter more arithmetic. BatchNorm uses the statistics of each chunk. 0 = the whole batch at once."""
    compile: bool = False
    """Compile the forward pass with torch.compile, as one graph. Worthwhile on GPUs."""
    seed: int = 0
    """Random seed of initial weights, batches, views and dropout."""
    device: str = "auto"
    """auto (a GPU if there is one), cpu, cuda or cuda:N."""
    log_every: Fixed[int] = 10
    """Steps between log lines. Each also checks that the loss is finite."""
    eval_every: int = 0
    """Steps between evaluations (linear probes, signs of collapse) on held-out groups (split val, never test). The
    weights that are best there are kept as model.best.safetensors. 0 = only at the start and the end."""
    checkpoint_every: int = 0
    """Steps between checkpoints. 0 = about every tenth of the run, at least 10 steps apart."""

    def __post_init__(self) -> None:
        check_range(self, 2, math.inf, "batch_size")  # each pair needs a negative
        check_range(self, 1e-30, math.inf, "epochs")
        check_range(self, 0, math.inf, "positives_within", "eval_every", "checkpoint_every")
        check_range(self, 1, math.inf, "log_every", *["steps"] * (self.steps is not None))
        check_range(self, 0, (1 << 63) - 1, "seed")
        if self.chunk and not (2 <= self.chunk <= self.batch_size and self.batch_size % self.chunk == 0):
            raise ValueError(f"chunk {self.chunk}: give a divisor of batch_size {self.batch_size}, at least 2, or 0")
        if self.positives_within and self.positives == "same-image":
            raise ValueError("positives_within has no effect on same-image positives: choose --positives same-touch")

    def num_steps(self, num_rows: int) -> int:
        """Number of optimiser steps of the whole run on ``num_rows`` training rows."""
        return max(1, round(self.epochs * self.steps_per_epoch(num_rows))) if self.steps is None else self.steps

    def steps_per_epoch(self, num_rows: int) -> int:
        """Number of full batches in one epoch. The last short batch is dropped: its queries would have fewer negatives."""
        return num_rows // self.batch_size

    def check(self, spec: DataSpec, num_rows: int, stored_size: int) -> None:
        """ValueError unless the settings fit each other, ``num_rows`` rows to train on and images of ``stored_size`` px."""
        if num_rows < self.batch_size:
            what = f"dataset {spec.name!r} has {num_rows} rows to train on, batch_size is {self.batch_size}"
            raise ValueError(f"{what}: give --batch-size {num_rows} or less" if num_rows > 1 else f"{what}: too few")
        if (self.steps or self.epochs * self.steps_per_epoch(num_rows)) > MAX_STEPS:
            given = f"steps {self.steps}" if self.steps else f"epochs {self.epochs}"
            raise ValueError(f"{given}: too many to finish on any machine, give at most {MAX_STEPS} steps in all")
        for modality in spec.modalities:
            encoder, size = self.encoder[modality], self.augment.size_of(modality)
            # Whole images may be enlarged: a network that learned on large ones sees more in them (docs/start.md).
            if size > stored_size and not self.augment.of(modality).fixed:
                what = f"{modality} of {size} px cannot be cut from images stored at {stored_size} px"
                raise ValueError(f"{what}: give --augment.size {stored_size} or less, or pack at a larger --data.size")
            if encoder.temporal != "stack" and spec.window.frames == 1:
                what = f"encoder.{modality}.temporal {encoder.temporal} has no effect on single images"
                raise ValueError(f"{what}: give --data.num-frames 2 or more, or leave it out")
            taken = self.init and modality in (self.init.modalities or spec.modalities)
            if encoder.locked and encoder.weights == SCRATCH and not taken:
                how = f"give --encoder.{modality}.weights, or --init"
                raise ValueError(f"{modality} is locked at random weights: {how}")
            if self.method.needs_vit:
                check_vit(encoder, self.method.name, size)
        if self.precision == "bf16" and self.device.startswith("mps"):
            raise ValueError("bf16 is not supported on mps: use --precision fp32")

    @property
    def bf16(self) -> bool:
        assert self.precision != "auto", "auto is resolved earlier (system.device.Hardware)"
        return self.precision == "bf16"

    def without_idle(self, spec: DataSpec) -> "Run":
        """This run with every setting that has no effect on the dataset at a fixed value: of two that train alike, one."""
        unseen = {m: ViewAugment() for m in ("vision", "touch") if m not in spec.modalities}
        encoder = replace(self.encoder, **dict.fromkeys(unseen, EncoderConfig()))
        augment = replace(self.augment, **unseen)
        return replace(self, recipe="", method=self.method.without_idle(spec), encoder=encoder, augment=augment)

    def fresh(self) -> "Run":
        """This run from random initial weights, which are all trained."""
        return replace(self, encoder=self.encoder.fresh())

    def digest(self) -> str:
        """Content address of all settings that decide the outcome. Start weights count by content, not by path."""
        init = self.init if self.init.digest else self.init.resolved()
        value = to_json(replace(self, init=replace(init, path=None)))
        for name in NOT_IN_DIGEST:
            del value[name]
        # Options that do not change the outcome: local ones, and how raw pixels would be compressed.
        for name in (*self.data.local, "store", "quality") if self.data.store == "raw" else self.data.local:
            del value["data"][name]
        return digest(value)

    @classmethod
    def load(cls, value: Any) -> "Run":
        """Create a run from the "run" object of a run.json."""
        return from_json(cls, value)


def load_run(path: Path) -> tuple[Run, dict[str, Any]]:
    """The ``Run`` and the whole record of a run.json, or of a run's folder; ValueError names the file and the field."""
    file = path / "run.json" if path.is_dir() else path
    record = read_json(file, "a run's record")
    if not isinstance(record, dict) or "run" not in record:
        raise ValueError(f"{file} is not a run's record: give the run.json that `mvitac pretrain` wrote")
    try:
        return Run.load(record["run"]), record
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from None


def precision_of(run: Run, record: dict[str, Any]) -> str:
    """The precision that a recorded run was computed in, with ``auto`` resolved."""
    return record.get("precision", run.precision)
