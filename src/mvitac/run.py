"""``Run``: everything that decides an outcome, as one frozen value that is written beside every result as run.json."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import tyro

from mvitac.data.spec import DataSpec
from mvitac.datasets.base import DatasetConfig
from mvitac.datasets.simulated import MaterialsConfig
from mvitac.methods.base import MethodConfig
from mvitac.methods.mvitac import MViTacConfig
from mvitac.nn.encoders import EncoderConfig
from mvitac.registry import from_json, to_json
from mvitac.system.files import digest, read_json
from mvitac.transforms.random_views import Augment, ViewAugment


def load_run(path: Path) -> tuple[Run, dict[str, Any]]:
    """The ``Run`` and the whole record of a run's folder."""
    return read_record(path / "run.json")


def read_record(file: Path) -> tuple[Run, dict[str, Any]]:
    """The ``Run`` and the whole record in a run.json; ValueError names the file and the field that does not fit."""
    record = read_json(file, "a run's record")
    if not isinstance(record, dict) or "run" not in record:
        raise ValueError(f"{file} is not a run's record: give the run.json that `mvitac pretrain` wrote")
    try:
        return Run.load(record["run"]), record
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from None


MAX_STEPS = 100_000_000
"""A budget beyond this is a slip of the keyboard: at a thousand steps a second it would take a day."""


@dataclass(frozen=True, kw_only=True)
class Optim:
    """The optimiser and its schedule."""

    name: Literal["adam", "adamw", "sgd"] = "adam"
    """Optimiser (paper: Adam)."""
    lr: float = 0.03
    """Peak learning rate (paper: .03)."""
    betas: tuple[float, float] = (0.9, 0.999)
    """Adam's decay rates; the first is SGD's momentum."""
    eps: float = 1e-7
    """Adam's epsilon (paper: 1e-7)."""
    weight_decay: float = 0.0
    """L2 penalty (adam, sgd) or decoupled decay (adamw); the paper names none."""
    schedule: Literal["constant", "cosine", "step"] = "constant"
    """constant; cosine to zero; or x0.9 every 10 epochs from epoch 10 on (the authors' StepLR). The paper names none."""
    warmup: float = 0.0
    """Share of all steps over which the rate rises linearly from zero."""

    def __post_init__(self) -> None:
        if not (self.lr > 0 and math.isfinite(self.lr)):
            raise ValueError(f"optim lr {self.lr}: give a positive learning rate")
        if not (0 <= self.betas[0] < 1 and 0 <= self.betas[1] < 1):
            raise ValueError(f"optim betas {self.betas}: give two numbers in [0, 1)")
        if not (self.eps > 0 and math.isfinite(self.eps)):
            raise ValueError(f"optim eps {self.eps}: give a positive number")
        if not (self.weight_decay >= 0 and math.isfinite(self.weight_decay)):
            raise ValueError(f"optim weight_decay {self.weight_decay}: give a number >= 0")
        if not 0 <= self.warmup < 1:
            raise ValueError(f"optim warmup {self.warmup}: give a share of the steps in [0, 1)")

    def rate(self, step: int, num_steps: int, epoch: int) -> float:
        """Learning rate of step ``step`` (from 0) out of ``num_steps``."""
        warm = int(self.warmup * num_steps)
        if step < warm:
            return self.lr * (step + 1) / warm
        if self.schedule == "cosine":
            return self.lr * 0.5 * (1 + math.cos(math.pi * (step - warm) / max(1, num_steps - warm)))
        if self.schedule == "step":
            return self.lr * 0.9 ** (epoch // 10)
        return self.lr


@dataclass(frozen=True, kw_only=True)
class Run:
    """One pre-training run: method, data, networks, views, optimiser, budget, seed."""

    recipe: tyro.conf.Suppress[str] = "paper"
    """The recipe this run started from, for the record."""
    method: MethodConfig = MViTacConfig()
    data: DatasetConfig = MaterialsConfig()
    encoder: EncoderConfig = EncoderConfig()
    augment: Augment = Augment()
    optim: Optim = Optim()
    batch_size: int = 256
    """Pairs per step; also the number of keys each query is told from (paper: 256)."""
    epochs: float = 240.0
    """Passes over the training rows (paper: 240)."""
    steps: int | None = None
    """If given, the number of steps, instead of epochs."""
    sampler: Literal["shuffle", "one-per-touch"] = "shuffle"
    """shuffle: plain permutation (paper). one-per-touch: rows of one touch group are spread over different batches, so
    that near-duplicates are not each other's negatives."""
    positives: Literal["same-image", "same-touch", "same-touch-pairs"] = "same-image"
    """What a query must find. same-image: another view of its own row (paper). same-touch: a view of another row of its
    touch group (another frame of the contact, another press of the thing), so that lamp, background, sensor and place,
    which differ between the two, cannot give the answer away; a row alone in its group is its own partner. Methods of one
    view (ssvtp, cmc) have one row's vision and touch under both; same-touch-pairs gives them the vision of one row and the
    touch of another."""
    precision: Literal["auto", "fp32", "tf32", "bf16"] = "fp32"
    """Arithmetic of the networks; losses, weights and the optimiser stay fp32. auto: bf16 where the hardware computes it
    (GPUs from Ampere, CPUs with AVX512-BF16 or AMX), else fp32; run.json says which. fp32 is never TF32 in silence; tf32
    lets a GPU round products to 10 bits."""
    chunk: int = 0
    """Pairs embedded at a time (gradient caching): a batch of any size in the memory of this many, for about a quarter
    more arithmetic; BatchNorm sees one chunk at a time. 0 = the whole batch at once."""
    recompute: bool = False
    """Recompute activations in the backward pass instead of keeping them (activation checkpointing)."""
    compile: bool = False
    """torch.compile the forward pass, in one graph: pays on GPUs."""
    seed: int = 0
    """Decides initial weights, batches, views and dropout."""
    device: str = "auto"
    """auto (a GPU if there is one), cpu, cuda or cuda:N."""
    log_every: int = 10
    """Steps between log lines, each of which also checks that the loss is finite."""
    eval_every: int = 0
    """Steps between kNN scores and collapse panels on held-out groups (val, never test); 0 = at the end only."""
    checkpoint_every: int = 0
    """Steps between checkpoints; 0 = about every tenth of the run."""

    def __post_init__(self) -> None:
        if self.batch_size < 2:
            raise ValueError(f"batch_size {self.batch_size}: contrast needs at least 2 pairs")
        if not (self.epochs > 0 and math.isfinite(self.epochs)):
            raise ValueError(f"epochs {self.epochs}: give a positive number")
        if self.chunk and not (2 <= self.chunk <= self.batch_size and self.batch_size % self.chunk == 0):
            raise ValueError(f"chunk {self.chunk}: give a divisor of batch_size {self.batch_size}, at least 2, or 0")
        if self.steps is not None and self.steps < 1:
            raise ValueError(f"steps {self.steps}: give at least 1, or leave it out to use epochs")
        if not 0 <= self.seed < 1 << 63:
            raise ValueError(f"seed {self.seed}: give a number from 0 to 2^63 - 1")
        if self.log_every < 1:
            raise ValueError(f"log_every {self.log_every}: give at least 1")
        for name, value in (("eval_every", self.eval_every), ("checkpoint_every", self.checkpoint_every)):
            if value < 0:
                raise ValueError(f"{name} {value}: give a number of steps >= 0")

    def num_steps(self, num_rows: int) -> int:
        """Optimiser steps of the whole run over ``num_rows`` training rows."""
        return self.steps or max(1, round(self.epochs * self.steps_per_epoch(num_rows)))

    def steps_per_epoch(self, num_rows: int) -> int:
        """Full batches in one pass; the last short one is dropped, as its queries would have fewer negatives."""
        return num_rows // self.batch_size

    def check(self, spec: DataSpec, num_rows: int, stored_size: int) -> None:
        """What can only be checked across fields and data; ValueError before the first second of training."""
        if num_rows < 2:
            raise ValueError(
                f"dataset {spec.name!r} has {num_rows or 'no'} rows in split train or unlabelled:"
                " pre-training needs at least 2 to tell apart"
            )
        if num_rows < self.batch_size:
            raise ValueError(
                f"dataset {spec.name!r} has {num_rows} rows to train on, batch_size is {self.batch_size}:"
                f" give --batch-size {num_rows} or less"
            )
        if (self.steps or self.epochs * self.steps_per_epoch(num_rows)) > MAX_STEPS:
            given = f"steps {self.steps}" if self.steps else f"epochs {self.epochs}"
            raise ValueError(f"{given}: more than any machine finishes, give at most {MAX_STEPS} steps in all")
        if self.augment.size > stored_size:
            raise ValueError(
                f"views of {self.augment.size} px cannot be cut from images stored at {stored_size} px:"
                f" give --augment.size {stored_size} or less, or pack the data at a larger --data.size"
            )
        if self.augment.eval_size > stored_size:
            raise ValueError(
                f"whole images of {self.augment.eval_size} px were stored at {stored_size} px:"
                f" give --augment.whole {stored_size} or less, or pack the data at a larger --data.size"
            )
        if self.precision == "bf16" and self.device.startswith("mps"):
            raise ValueError("bf16 is not supported on mps: use --precision fp32")

    @property
    def bf16(self) -> bool:
        """Whether the networks compute in bf16."""
        assert self.precision != "auto", "what auto means is decided before (device.pick_precision)"
        return self.precision == "bf16"

    def without_idle(self, spec: DataSpec) -> Run:
        """The same training on a dataset, settings that do nothing there at one value: equal ones train alike."""
        unseen = {m: ViewAugment() for m in ("vision", "touch") if m not in spec.modalities}
        return replace(self, recipe="", method=self.method.without_idle(spec), augment=replace(self.augment, **unseen))

    def digest(self) -> str:
        """Content address of the outcome: where it runs and how often it reports do not count."""
        value = to_json(self)
        for name in ("device", "log_every", "eval_every", "checkpoint_every"):
            del value[name]
        # What is as it was before there was a choice has the digest it had then: raw packs, plain flips, no
        # noise, crossed pairs.
        for name in (*self.data.local, *(("store", "quality") if self.data.store == "raw" else ())):
            del value["data"][name]
        if self.augment.gel_flip == "plain":
            del value["augment"]["gel_flip"]
        if value["method"].get("pairs") == "crossed":
            del value["method"]["pairs"]
        for modality in ("vision", "touch"):
            if not value["augment"][modality]["noise"]:
                del value["augment"][modality]["noise"]
        return digest(value)

    @classmethod
    def load(cls, value: Any) -> Run:
        """A run from the "run" object of a run.json."""
        return from_json(cls, value)
