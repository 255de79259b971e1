"""Named tensors in safetensors files: read, write, digest, compare with what a network needs."""

import hashlib
from pathlib import Path
from typing import Any

import safetensors.torch
import torch
from torch import Tensor

from mvitac.system.files import brief, digest, write_atomic

FORMAT = "mvitac-model"


def read_safetensors(file: Path) -> tuple[dict[str, str], dict[str, Tensor]]:
    """Header and tensors of ``file``; ValueError if it cannot be read."""
    try:
        with safetensors.safe_open(file, framework="pt") as opened:
            return opened.metadata() or {}, {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118
    except Exception as error:  # safetensors raises several types for damaged files
        raise ValueError(f"{file} cannot be read as safetensors ({brief(error)}): copy it again or re-train") from None


def write_model(path: Path, tensors: dict[str, Tensor], about: dict[str, str]) -> None:
    """Write the weights of a model, with the texts ``about`` it and digests of both in the header."""
    header = {"format": FORMAT, **about, "digest": safetensors_digest(tensors)}
    header["header_digest"] = digest([*about.values()])
    data = safetensors.torch.save(tensors, metadata=header)
    write_atomic(path, lambda file: file.write(data))


def read_model(file: Path, about: tuple[str, ...]) -> tuple[dict[str, str], dict[str, Tensor]]:
    """Header and tensors of a file of ``write_model``, whose texts have the names ``about``; ValueError if it is damaged."""
    header, tensors = read_safetensors(file)
    if header.get("format") != FORMAT:
        raise ValueError(f"{file} was not written by mvitac: its header lacks format={FORMAT}")
    if safetensors_digest(tensors) != header.get("digest"):
        raise ValueError(f"{file} does not match its digest: the weights were changed or damaged")
    given = digest([header.get(name) for name in about])
    if header.get("header_digest", given) != given:
        raise ValueError(f"{file} does not match its header's digest: it was changed or damaged")
    return header, tensors


def safetensors_digest(tensors: dict[str, Tensor]) -> str:
    """sha256 of names, shapes, types and values."""
    total = hashlib.sha256()
    for name in sorted(tensors):
        total.update(f"{name} {tuple(tensors[name].shape)} {tensors[name].dtype}\n".encode())
        total.update(tensors[name].reshape(-1).view(torch.uint8).numpy().tobytes())
    return total.hexdigest()


def misfit(expected: dict[str, Tensor], found: dict[str, Any]) -> str:
    """Say in which name or shape tensors differ from the ``expected`` ones; "" if in none."""
    for name in sorted(expected.keys() ^ found.keys()):
        return f"tensor {name!r} {'is missing' if name in expected else 'has no place in this network'}"
    for name, tensor in expected.items():
        if tensor.shape != found[name].shape:
            return f"{name!r} is {tuple(found[name].shape)}, expected {tuple(tensor.shape)}"
    return ""
