"""Evaluation during training on held-out groups (split val, never test): what the features are worth, from step 0 on.

A linear probe, retrieval and signs of collapse. The start (step 0) is the baseline. The best weights are those with the
lowest errors of the linear probe (``diagnostics.mean_error``).
"""

import math
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import numpy as np
import torch
from scipy.special import stdtrit
from torch import Tensor

from mvitac.data.pack import Pack
from mvitac.data.several import MixedPack
from mvitac.data.spec import AnyTask, Task
from mvitac.evaluation import diagnostics
from mvitac.evaluation.features import pack_features, sample
from mvitac.evaluation.intervals import MIN_GROUPS
from mvitac.model import BEST, Model
from mvitac.run import Run
from mvitac.training.log import Log
from mvitac.training.setup import Setup

NUM_EVAL_TRAIN, NUM_EVAL_VAL = 1024, 512
Cells = dict[str, Tensor]
"""Task and modality -> [targets, groups, 2]: the sum of errors of each group, and that of a guess. A score is 1 - their
ratio: accuracy of a class (errors: wrong rows; guess: all rows), R2 of a value (squared errors; those of the mean)."""


class Validation:
    """Evaluates a method while it trains, compares it with its start, and keeps the best weights.

    ``setup.validation_state`` is the state of the last checkpoint, which a resumed run continues with; empty at the start.
    """

    def __init__(self, out: Path, setup: Setup, log: Log) -> None:
        self.out, self.run, self.method, self.pack, self.spec = out, setup.run, setup.method, setup.pack, setup.spec
        self.log, self.state, self.locked = log, setup.validation_state, setup.views.locked

    def __call__(self, step: int, *, last: bool = False) -> None:
        """Evaluate after ``step`` steps; write model.best.safetensors if it is the best so far."""
        model = Model(self.method, self.run, self.spec, self.pack.size)
        values, cells = validate(model, self.pack, self.run, self.locked)
        self.method.train()
        if step == 0:
            self.state["baseline"] = cells
        if cells and (error := _error(cells)) < self.state.get("best", math.inf):
            self.state |= {"best": error, "best_step": step}
            if self.run.eval_every:
                model.save(self.out / BEST)
                self.method.train()
        start = self.state.get("baseline") if last else None  # a run that began without validation has none
        said = [] if start is None else verdict(start, cells, self.pack.spec.group_by)
        if start and self.run.eval_every and cells:
            change = f"errors {100 * (self.state['best'] / _error(start) - 1):+.0f} % in the mean over tasks"
            said += [f"best at step {self.state['best_step']} ({change}, {BEST})"]
        self.log.evaluation(step, values, said)


def validate(
    model: Model, pack: Pack, run: Run, locked: Mapping[str, Tensor] = MappingProxyType({})
) -> tuple[dict[str, float], Cells]:
    """Scores on held-out groups (split val, never test), and the linear probes' errors by group, to compare evaluations.

    Only rows with both modalities are used. Without rows of val that are not trained on, the scores are computed on
    training rows, and there are no probes. Scores are by name, e.g. "touch/linear category", "vision/rankme",
    "vision->touch R@5"; of a mix, those of each part, named "<part> <name>".

    ``locked``: modality -> features [pack.num, D] that are known already.
    """
    if not isinstance(pack, MixedPack):
        return _validate(model, pack, run, locked)
    found = {part: _validate(model, pack.alone(part), run, {}) for part in pack.parts}
    values = {f"{part} {name}": value for part, (own, _) in found.items() for name, value in own.items()}
    return values, {f"{part} {name}": cell for part, (_, own) in found.items() for name, cell in own.items()}


@torch.no_grad()
def _validate(model: Model, pack: Pack, run: Run, locked: Mapping[str, Tensor]) -> tuple[dict[str, float], Cells]:
    def read(m: str, rows: np.ndarray) -> Tensor:
        return locked[m][rows].cpu() if m in locked else pack_features(model, pack, m, rows, bf16=run.bf16)

    rng = np.random.default_rng(0)  # the same rows at every step and for every seed
    modalities = pack.spec.modalities
    train_rows = sample(pack.rows("train", "unlabelled", having=modalities), NUM_EVAL_TRAIN, rng)
    val_rows = np.setdiff1d(pack.rows("val", having=modalities), run.method.training_rows(pack))
    held_out = len(val_rows) > 1
    rows = sample(val_rows, NUM_EVAL_VAL, rng) if held_out else train_rows[:NUM_EVAL_VAL]
    z = {m: read(m, rows) for m in model.encoders if m in modalities}
    signs = {"std": diagnostics.spread, "rankme": diagnostics.rank_me}
    values = {f"{m}/{name}": sign(found) for m, found in z.items() for name, sign in signs.items()}
    values["held-out rows"] = float(held_out * len(rows))
    cells = _linear(pack, train_rows, rows, {m: read(m, train_rows) for m in z}, z) if held_out else {}
    values |= {name: float(_scores(cell).mean()) for name, cell in cells.items()}
    if len(model.projectors) == len(z) == 2:
        values |= _shared_space(model, pack, run, rows, z)
    return values, cells


def _linear(
    pack: Pack, train_rows: np.ndarray, rows: np.ndarray, train_features: dict[str, Tensor], z: dict[str, Tensor]
) -> Cells:
    """Errors by group on ``rows``, with features ``z``, of linear probes of each task by each modality and by both."""
    if len(z) > 1:
        train_features, z = (found | {"both": torch.cat(list(found.values()), dim=1)} for found in (train_features, z))
    names = np.unique(pack.column("group").astype(str), return_inverse=True)[1]
    groups = torch.from_numpy(names[train_rows])
    by_group, cells = torch.from_numpy(np.unique(names[rows], return_inverse=True)[1]), {}
    for task in pack.spec.all_tasks:
        known, asked = _answers(pack, task, "train", train_rows), _answers(pack, task, "val", rows)
        for m in z:
            found = []
            for y, true in zip(known, asked, strict=True):
                have, scored = ~y.isnan().any(1), ~true.isnan().any(1)
                if len(torch.unique(y[have], dim=0)) < 2 or len(torch.unique(true[scored], dim=0)) < 2:
                    continue
                guess = diagnostics.linear_probe(train_features[m][have], y[have], groups[have], z[m][scored])
                sums = torch.zeros(int(by_group.max()) + 1, 2, dtype=torch.float64)
                found.append(sums.index_add_(0, by_group[scored], _errors(guess, true[scored])))
            if found:
                cells[f"{m}/linear {task.name}"] = torch.stack(found)
    return cells


def _answers(pack: Pack, task: AnyTask, split: str, rows: np.ndarray) -> list[Tensor]:
    """What a probe fits: one column per class of a task, or one column for each value on its own; NaN = not known.
    Values are standardised, which changes no R2, so that float32 holds them."""
    if not isinstance(task, Task):
        every = pack.values(task)
        scaled = (pack.values(task, split)[rows] - np.nanmean(every, axis=0)) / (np.nanstd(every, axis=0) + 1e-100)
        return [torch.from_numpy(column[:, None]).float() for column in scaled.T]
    labels = torch.from_numpy(pack.labels(task.name, split))[rows]
    columns = torch.nn.functional.one_hot(labels.clamp(min=0), len(task.classes)).float()
    columns[labels < 0] = torch.nan
    return [columns]


def _errors(guess: Tensor, true: Tensor) -> Tensor:
    """[rows, 2]: each row's error, and that of a guess without features (``Cells``)."""
    if true.shape[1] > 1:
        wrong = (guess.argmax(1) != true.argmax(1)).double()
        return torch.stack([wrong, torch.ones_like(wrong)], dim=1)
    return torch.cat([guess - true, true.mean() - true], dim=1).double().square()


def _scores(cell: Tensor) -> Tensor:
    """[targets]: accuracy or R2."""
    errors, guess = cell.sum(1).unbind(-1)
    return 1 - errors / guess.clamp(min=1e-12)


def _error(cells: Cells) -> float:
    return diagnostics.mean_error(_scores(cell).tolist() for cell in cells.values())


def verdict(start: Cells, end: Cells, by: str) -> list[str]:
    """The clauses of a sentence: what of the linear probe's scores on split val rose since the start, and what fell.

    Each interval (95 %) is over groups: a jackknife that leaves out one at a time. Variation between seeds is not in it.
    """
    few = f"cannot tell with under {MIN_GROUPS} {by}s"
    said: dict[str, list[str]] = {word: [] for word in ("rose", "fell", "neither", few)}
    for name in sorted(start.keys() & end.keys()):
        keep = (end[name][..., 1] > 0).all(0)  # groups with rows in every target
        if start[name].shape != end[name].shape or not (num := int(keep.sum())):
            continue
        points, margin = _change(start[name][:, keep], end[name][:, keep])
        text = f"{name.replace('linear ', '')} {points:+.1f}"
        if num < MIN_GROUPS:
            word = few
        else:
            word = "neither" if abs(points) <= margin else "rose" if points > 0 else "fell"
            text += f" [{points - margin:+.1f}, {points + margin:+.1f}]"
        said[word].append(text)
    if not (found := [f"{word}: {', '.join(texts)}" for word, texts in said.items() if texts]):
        return ["split val has no labels of two classes, and no values, that were not trained on: no verdict"]
    return [f"compared with the start (linear probe, points of accuracy or R2 on {by}s of val), {found[0]}", *found[1:]]


def _change(start: Tensor, end: Tensor) -> tuple[float, float]:
    """How many points a score has risen, and half the width of its interval over groups (0 for one group)."""
    points, num = float(100 * (_scores(end) - _scores(start)).mean()), end.shape[1]
    if num < 2:
        return points, 0.0
    before, after = (cell.sum(1, keepdim=True) - cell for cell in (start, end))  # without each group
    without = 100 * (_scores(after[:, None]) - _scores(before[:, None])).mean(0)  # [groups]
    squares = (num - 1) / num * float((without - without.mean()).square().sum())
    return points, float(stdtrit(num - 1, 0.975)) * squares**0.5


def _shared_space(model: Model, pack: Pack, run: Run, rows: np.ndarray, z: dict[str, Tensor]) -> dict[str, float]:
    """Retrieval in the space shared by both modalities, among ``rows``, whose features are ``z``."""
    device = next(model.parameters()).device
    for m, (whole, heads) in {m: model.image_sizes(m) for m in z}.items():
        if whole != heads:
            z = z | {m: pack_features(model, pack, m, rows, for_heads=True, bf16=run.bf16)}
    shared = {m: model.project(m, z[m].to(device)).cpu() for m in z}
    groups = torch.from_numpy(np.unique(pack.column("group")[rows], return_inverse=True)[1])
    values = {}
    for query, gallery in (("vision", "touch"), ("touch", "vision")):
        ranks = diagnostics.retrieval_ranks(shared[query], shared[gallery], groups)
        values |= {f"{query}->{gallery} {name}": value for name, value in diagnostics.recall_at(ranks, (1, 5)).items()}
    values["chance R@5"] = min(1.0, 5 / (int(groups.max()) + 1))
    return values
