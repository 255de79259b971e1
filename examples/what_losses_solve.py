"""What runs on vt60 learned (docs/results/real.md): probes of frozen features at the start and at the end, on split val.

    python examples/what_losses_solve.py RUN...

Everything is scored on val, never on test. Category and pose: fitted on train objects, scored on val objects. Object:
fitted on every other touch of each train object, scored on the others. Light: R2 of the main components of the pixels at the
border. Border, centre: category by touch where the rest of the image is gray.
"""

import sys
from pathlib import Path

import numpy as np
import torch

import mvitac
from mvitac.evaluation.controls import borders, thumbnails
from mvitac.evaluation.diagnostics import linear_probe
from mvitac.model import Model, fresh

EDGE = 9  # pixels of 72: the border of ``controls.borders``


def masked(images: np.ndarray, keep: str) -> np.ndarray:
    """``images`` [N, H, W, C] with the centre, or all but the centre, gray."""
    inside = np.zeros(images.shape[1:3], bool)
    inside[EDGE:-EDGE, EDGE:-EDGE] = True
    hidden = inside if keep == "border" else ~inside
    return np.where(hidden[None, :, :, None], np.uint8(128), images)


@torch.no_grad()
def features(model: Model, images: np.ndarray, modality: str) -> torch.Tensor:
    chunks = (torch.from_numpy(images[i : i + 128]).permute(0, 3, 1, 2) for i in range(0, len(images), 128))
    return torch.cat([model.features(modality, chunk) for chunk in chunks])


def accuracy(z: torch.Tensor, y: np.ndarray, groups: np.ndarray, new: torch.Tensor, true: np.ndarray) -> float:
    columns = torch.nn.functional.one_hot(torch.from_numpy(y)).float()
    guess = linear_probe(z, columns, torch.from_numpy(groups), new).argmax(1)
    return 100 * float((guess == torch.from_numpy(true)).float().mean())


def r2(z: torch.Tensor, y: np.ndarray, groups: np.ndarray, new: torch.Tensor, true: np.ndarray) -> float:
    scores = []
    for fitted, wanted in zip(y.T, true.T, strict=True):
        guess = linear_probe(z, torch.from_numpy(fitted[:, None]).float(), torch.from_numpy(groups), new)[:, 0]
        error = ((guess.numpy() - wanted) ** 2).sum() / ((wanted - wanted.mean()) ** 2).sum()
        scores.append(1 - error)
    return float(np.mean(scores))


def main(paths: list[Path]) -> None:
    pack = mvitac.load(paths[0]).open_data(quiet=True)
    train, val = pack.rows("train"), pack.rows("val")
    names = np.unique(pack.column("group").astype(str), return_inverse=True)[1]
    labels = pack.column("label_category").astype(int)
    pose = np.stack([pack.column(name).astype(float) for name in "xyz"], axis=1)
    light = borders(pack, "touch", np.arange(pack.num))
    centre = light[train].mean(0)
    light = (light - centre) @ np.linalg.svd(light[train] - centre, full_matrices=False)[2][:8].T
    seen = np.unique(names[train], return_inverse=True)[1]
    half = np.arange(len(train)) % 2 == 0

    def scores(z: dict[str, torch.Tensor], y: dict[str, torch.Tensor]) -> list[float]:
        """Columns of the table from features of train and val."""
        both = [torch.cat([part["vision"], part["touch"]], dim=1) for part in (z, y)]
        pairs = [(z["touch"], y["touch"]), (z["vision"], y["vision"]), both]
        found = [accuracy(a, labels[train], names[train], b, labels[val]) for a, b in pairs]
        found += [accuracy(a[half], seen[half], np.arange(half.sum()), a[~half], seen[~half]) for a, _ in pairs[:2]]
        found += [r2(z["touch"], v[train], names[train], y["touch"], v[val]) for v in (pose, light)]
        return found

    print("| | category: touch | vision | both | object: touch | vision | pose R2 | light R2 | border | centre |")
    print("|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|")
    pixels = [{m: torch.from_numpy(thumbnails(pack, m, rows)) for m in ("vision", "touch")} for rows in (train, val)]
    ring = [torch.from_numpy(borders(pack, "touch", rows)) for rows in (train, val)]
    only = accuracy(ring[0], labels[train], names[train], ring[1], labels[val])
    show("pixels", [*scores(*pixels), only])
    shown = set()
    for path in paths:
        end = mvitac.load(path)
        start = fresh(end.run, end.spec, end.stored)
        for name, model in ((f"start, seed {end.run.seed}", start.eval()), (path.name, end)):
            if name in shown:
                continue
            shown.add(name)
            z, y = ({m: features(model, pack.images[m][r], m) for m in ("vision", "touch")} for r in (train, val))
            parts = []
            for keep in ("border", "centre"):
                a, b = (features(model, masked(pack.images["touch"][r], keep), "touch") for r in (train, val))
                parts.append(accuracy(a, labels[train], names[train], b, labels[val]))
            show(name, [*scores(z, y), *parts])


def show(name: str, values: list[float]) -> None:
    cells = [f"{value:.2f}" if 5 <= i < 7 else f"{value:.1f}" for i, value in enumerate(values)]
    print(f"| {name} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(f"usage: python {sys.argv[0]} RUN...")
    main([Path(word) for word in sys.argv[1:]])
