"""Features of a pack's rows from a frozen model, kept in a cache on disk."""

import copy
import hashlib
import io
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from mvitac.data.pack import Pack
from mvitac.data.spec import MODALITIES
from mvitac.model import Model
from mvitac.nn.folded import folded
from mvitac.system.files import cache_dir, check_ordinary, digest, write_atomic
from mvitac.system.malloc import keep_freed_memory
from mvitac.system.progress import work
from mvitac.system.threads import in_threads


def sample(rows: np.ndarray, num: int, rng: np.random.Generator | None = None) -> np.ndarray:
    """Draw at most ``num`` of ``rows`` at random, in order; without ``rng`` the same rows on every call.

    Rows cycle through the classes, so a fixed stride would miss most of them.
    """
    rng = rng or np.random.default_rng(0)
    return np.sort(rng.choice(rows, min(num, len(rows)), replace=False))


def fitting(model: Model, pack: Pack, among: Sequence[str] = MODALITIES, *, in_use: bool = False) -> tuple[str, ...]:
    """Those ``among`` modalities that model and pack have in common; ValueError if there are none, or images do not fit.

    ``in_use``: nor do difference images, where the model will be given plain ones, nor images of another stored size.
    """
    names = tuple(m for m in pack.spec.modalities if m in model.encoders and m in among)
    for modality in names:
        found, wanted = pack.spec.channels(modality), model.spec.channels(modality)
        if found != wanted:
            raise ValueError(f"{pack.path} has {found} channels of {modality}, the model was trained with {wanted}")
    if "touch" in names and model.spec.difference and not pack.spec.difference:
        raise ValueError(f"{pack.path}: the model was trained on difference images: pack with --subtract-background")
    if in_use and "touch" in names and pack.spec.difference and not model.spec.difference:
        raise ValueError(f"{pack.path}: the model was trained without difference images: no --subtract-background")
    if in_use and pack.size != model.stored:  # images in use are resized to that first: features would be others
        raise ValueError(f"{pack.path} has images of {pack.size} px: pack it again with --size {model.stored}")
    if not names:
        raise ValueError(f"{pack.path} has {', '.join(pack.spec.modalities)}, the model {', '.join(model.encoders)}")
    return names


def features(model: Model, pack: Pack, modality: str, rows: np.ndarray, *, for_heads: bool = False) -> np.ndarray:
    """Features [len(rows), D] float32, cached on disk by weights, data, rows and image size (``Model.features``).

    The cached file is a .npy followed by its sha256. One that does not match, or has none, is computed again.
    """
    every = np.arange(pack.num)
    if len(rows) < pack.num and _place(model, pack, modality, every, for_heads=for_heads).exists():
        return features(model, pack, modality, every, for_heads=for_heads)[rows]
    path = _place(model, pack, modality, rows, for_heads=for_heads)
    if path.exists():
        check_ordinary(path)  # a pipe never ends
        data = path.read_bytes()
        if hashlib.sha256(memoryview(data)[:-32]).digest() == data[-32:]:
            return np.load(io.BytesIO(data), allow_pickle=False)
    with work(f"reading {modality} features", len(rows), "images") as advance:
        values = pack_features(model, pack, modality, rows, for_heads=for_heads, advance=advance).numpy()
    constant = len(rows) > 1 and np.ptp(values, axis=0).max() <= 1e-6 * np.abs(values).max()
    if constant and np.ptp(pack.images[modality][rows[:64]], axis=0).any():
        raise ValueError(f"features of {modality} are the same for all {len(rows)} images: check the weights")
    buffer = io.BytesIO()
    np.save(buffer, values)
    buffer.write(hashlib.sha256(buffer.getbuffer()).digest())
    write_atomic(path, lambda file: file.write(buffer.getbuffer()))
    return values


def _place(model: Model, pack: Pack, modality: str, rows: np.ndarray, *, for_heads: bool) -> Path:
    whole, heads = model.image_sizes(modality)  # the key covers the first
    kind = [heads] if for_heads and heads != whole else []
    device = next(model.parameters()).device.type
    key = digest([model.features_key(modality), pack.digest, modality, digest(rows.tolist()), device, *kind])
    return cache_dir() / "features" / f"{key[:32]}.npy"


def pack_features(
    model: Model,
    pack: Pack,
    modality: str,
    rows: np.ndarray,
    *,
    for_heads: bool = False,
    bf16: bool = False,
    advance: Callable[[int], object] = lambda num: None,
) -> Tensor:
    """``Model.features`` [len(rows), D] of pack rows, on the CPU, in chunks: ``advance`` gets each one's row count."""
    device = next(model.parameters()).device
    if device.type == "cpu":
        keep_freed_memory()  # else every activation is mapped again: over twice the time on a virtual machine
    size = 64 if device.type == "cpu" else 256  # more leave the cache: with 256, EfficientNet takes 1.5 times as long

    def read(model: Model, rows: np.ndarray) -> Tensor:
        images = torch.from_numpy(pack.images[modality][rows]).permute(0, 3, 1, 2).to(device)
        return model.features(modality, images, for_heads=for_heads, bf16=bf16).detach().cpu()

    if device.type == "cpu" and not bf16 and len(rows) > 4 * size:
        expected, faster = read(model, rows[:2]), _folded(model, modality)
        if (read(faster, rows[:2]) - expected).abs().max() <= 1e-4 * expected.abs().max():
            model = faster

    def read_chunk(chunk: np.ndarray) -> Tensor:
        values = read(model, chunk)
        advance(len(chunk))
        return values

    chunks = np.array_split(rows, max(1, len(rows) // size))
    several = device.type == "cpu" and model.thread_safe
    return torch.cat(in_threads(read_chunk, chunks) if several else list(map(read_chunk, chunks)))


def _folded(model: Model, modality: str) -> Model:
    encoders, made = {**model.encoders, modality: folded(model.encoders[modality])}, copy.copy(model)
    made._modules = {**model._modules, "encoders": nn.ModuleDict(encoders)}
    return made
