"""Named tensors in files: read, write, digest, load strictly into a network.

Shapes: O filters, C channels, h x w pixels of a kernel.
"""

import argparse
import hashlib
import sys
import warnings
import zipfile
from collections.abc import Collection, Iterable
from functools import cache, partial
from pathlib import Path
from typing import Any

import safetensors.torch
import torch
from jaxtyping import Float
from timm.models import adapt_input_conv
from torch import Tensor, nn

from mvitac.system.files import brief, digest, write_atomic

State = dict[str, Tensor]
FORMAT = "mvitac-model"
PREFIXES = ("state_dict", "model", "module", "backbone", "encoder", "encoder_q")
"""Parts in front of the names of a network's tensors, and entries of a file below which they are."""


def read_safetensors(file: Path) -> tuple[dict[str, str], State]:
    """Header and tensors of ``file``; ValueError if it cannot be read."""
    try:
        with safetensors.safe_open(file, framework="pt") as opened:
            return opened.metadata() or {}, {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118
    except Exception as error:  # safetensors raises several types for damaged files
        raise ValueError(f"{file} cannot be read as safetensors ({brief(error)}): copy it again or re-train") from None


def write_model(path: Path, tensors: State, about: dict[str, str]) -> None:
    """Write the weights of a model, with the texts ``about`` it and digests of both in the header."""
    header = {"format": FORMAT, **about, "digest": safetensors_digest(tensors)}
    header["header_digest"] = digest([*about.values()])
    write_atomic(path, lambda file: file.write(safetensors.torch.save(tensors, metadata=header)))


def read_model(file: Path, about: tuple[str, ...]) -> tuple[dict[str, str], State]:
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


def safetensors_digest(tensors: State) -> str:
    """sha256 of names, shapes, types and values."""
    total = hashlib.sha256()
    for name in sorted(tensors):
        total.update(f"{name} {tuple(tensors[name].shape)} {tensors[name].dtype}\n".encode())
        total.update(tensors[name].reshape(-1).view(torch.uint8).numpy().tobytes())
    return total.hexdigest()


def read_tensors(file: Path) -> State:
    """Named tensors of a .safetensors or torch file; those of dicts inside have the names of their entries in front.

    Objects are never unpickled. ValueError if the file cannot be read, or holds no tensor.
    """
    if file.suffix == ".safetensors":
        return read_safetensors(file)[1]
    try:
        # Several owners keep their options in the file. torch warns of TorchScript.
        with torch.serialization.safe_globals([argparse.Namespace]), warnings.catch_warnings(action="ignore"):
            found = _flat(load_checked(file))
    except Exception:  # torch raises several types
        why = "is damaged, or cannot be read without running code from it: a state_dict is read, or .safetensors"
        raise ValueError(f"{file} {why}") from None
    if not found:
        raise ValueError(f"{file} holds no named weights")
    return found


def load_checked(file: Path) -> Any:
    """What a file of torch holds, whose checksums are right: torch.load does not compare them. No code of it is run."""
    if zipfile.is_zipfile(file):
        with zipfile.ZipFile(file) as archive:
            if any(entry.compress_type for entry in archive.infolist()):  # torch stores: a small file could fill memory
                raise ValueError("it is compressed")
            if name := archive.testzip():
                raise ValueError(f"{name} does not match its checksum")
    return torch.load(file, map_location="cpu", weights_only=True)


def said_trained_on(file: Path) -> str:
    """What the owner of a .safetensors file says in its header ("trained_on") that it was trained on; "" if nothing."""
    return read_safetensors(file)[0].get("trained_on", "") if file.suffix == ".safetensors" and file.exists() else ""


def _flat(value: Any, start: str = "") -> State:
    if isinstance(value, Tensor) and (value.layout, value.device.type) == (torch.strided, "cpu"):  # no sparse one
        return {start: value}
    inner = value.items() if isinstance(value, dict) else ()
    return {n: t for key, each in inner for n, t in _flat(each, f"{start}.{key}" if start else str(key)).items()}


def load_weights(network: nn.Module, tensors: State, file: Path | str) -> None:
    """Load other people's weights into a timm model without its classifier: all of them, or none.

    ``PREFIXES`` in front of names are left out, and so is what the file holds beside them; stderr says both. A classifier
    is left out. First convolutions are adapted to the number of channels (``adapt_stem``), names of owners that timm
    knows are converted by it. ValueError if anything is missing or left over, has another shape or is not finite.
    """
    expected, fitting, reasons = network.state_dict(), {}, {}
    for start in _starts(tensors):
        named = below(start, tensors).keys()  # timm would choose between two sets
        several = expected.keys() <= named and len(named) >= 2 * len(expected)
        for convert in (dict, partial(_converted, network))[: 1 if several else 2]:
            state = _prepared(network, convert(below(start, tensors)), expected)
            if not (why := misfit(expected, state)):
                fitting[start] = state
                break
            reasons.setdefault(start, (len(expected.keys() & state.keys()), why))
    # A whole set of names beside the one that fits is another network: nothing says which is meant.
    others = [start for start in reasons if start not in fitting] if fitting else []
    rivals = [start for start in others if expected.keys() <= below(start, tensors).keys()]
    if len(fitting) != 1 or rivals:
        two = f"two sets of weights fit, below {' and '.join(map(repr, [*fitting, *rivals]))}"
        why = two if fitting else max(reasons.values(), key=lambda reason: reason[0])[1]
        raise ValueError(f"{file} does not fit {_cfg(network).get('architecture', type(network).__name__)}: {why}")
    ((start, state),) = fitting.items()
    if bad := [name for name, value in state.items() if value.is_floating_point() and not value.isfinite().all()]:
        raise ValueError(f"{file} holds NaN or infinite numbers: {_some(bad)}")
    if not any(value.any() for value in state.values() if value.ndim > 1):
        raise ValueError(f"{file} holds weights that are all 0")
    network.load_state_dict(state)
    if start:
        beside = [name for name in tensors if not name.startswith(start)]
        _say(f"{file}: weights read below {start!r}" + f"; left out: {_some(beside)}" * bool(beside))


def below(start: str, tensors: State) -> State:
    return {name.removeprefix(start): value for name, value in tensors.items() if name.startswith(start)}


@cache
def _say(line: str) -> None:
    """Once, although each modality reads the file."""
    print(f"mvitac: {line}", file=sys.stderr)


def _starts(names: Iterable[str]) -> dict[str, None]:
    found = {"": None}
    for name in names:
        start = ""
        for part in name.split(".")[:-1]:
            if part not in PREFIXES:
                break
            found[start := f"{start}{part}."] = None
    return found


def _converted(network: nn.Module, state: State) -> State:
    """``state`` with the names, and positions of the size, of timm's model; as it is where it cannot, or scales patches."""
    convert = getattr(sys.modules[type(network).__module__], "checkpoint_filter_fn", None)
    try:
        found = convert(dict(state), network) if convert else state
    except Exception:  # whatever timm's function makes of another network's weights
        return state
    patches = found.get("patch_embed.proj.weight")
    shapes = {tensor.shape for tensor in state.values() if tensor.ndim == 4}
    return found if patches is None or not shapes or patches.shape in shapes else state


def _prepared(network: nn.Module, state: State, expected: State) -> State:
    """``state`` without a classifier, with first convolutions of the network's channels, and with counts of BatchNorm."""
    classifier = _cfg(network).get("classifier") or ()
    ends = tuple(f"{name}." for name in ([classifier] if isinstance(classifier, str) else classifier))
    state = {name: value for name, value in state.items() if name in expected or not name.startswith(ends or "\0")}
    state |= {n: v for n, v in expected.items() if n.endswith("num_batches_tracked") and n not in state}
    for name in stem_names(network):
        own, other = expected.get(f"{name}.weight"), state.get(f"{name}.weight")
        if own is not None and other is not None and own.ndim == other.ndim == 4 and not other.shape[1] % 3:
            state[f"{name}.weight"] = adapt_stem(other, own.shape[1])
    return state


def _cfg(network: nn.Module) -> dict[str, Any]:
    return getattr(network, "pretrained_cfg", None) or {}


def stem_names(trunk: nn.Module) -> list[str]:
    """Names of the convolutions of a timm model that see the image."""
    if known := _cfg(trunk).get("first_conv"):
        return [known] if isinstance(known, str) else list(known)
    return [name for name, module in trunk.named_modules() if isinstance(module, nn.Conv2d)][:1]


def adapt_stem(weight: Float[Tensor, "O C h w"], channels: int) -> Float[Tensor, "O channels h w"]:
    """Filters of a first convolution for another number of channels, both multiples of three.

    Three to more: repeated and rescaled, as timm does. More to three: summed over the images on the channels. Either way the
    response to the same picture in all places stays the same. An equal number is left as it is.
    """
    if weight.shape[1] == channels:
        return weight
    if weight.shape[1] > 3:
        _say(f"a first convolution of {weight.shape[1]} channels is made one of {channels}")
    return adapt_input_conv(channels, weight.unflatten(1, (-1, 3)).sum(1))


def misfit(expected: State, found: dict[str, Any]) -> str:
    """Say in which names or shapes tensors differ from the ``expected`` ones, with counts and first names; "" if in none."""
    both = [(name, found[name], own) for name, own in expected.items() if name in found]
    wrong = {
        "missing": [name for name in expected if name not in found],
        "left over": [name for name in found if name not in expected],
        "of another shape": [f"{n} {[*a.shape]} for {[*b.shape]}" for n, a, b in both if a.shape != b.shape],
        "not of floats of 16 bits or more": [
            n for n, a, b in both if b.is_floating_point() and not (a.is_floating_point() and a.dtype.itemsize > 1)
        ],
    }
    return ", ".join(f"{_some(names)} {what}" for what, names in wrong.items() if names)


def _some(names: Collection[str]) -> str:
    return f"{len(names)} tensor{'s' * (len(names) > 1)} ({', '.join([*names][:3])}{', ...' * (len(names) > 3)})"
