"""What outlives pre-training: frozen encoders (and the heads into the shared space), ready for raw images.

model = mvitac.load("runs/demo/seed0")
features = model.embed(vision=photos, touch=presses)      # {"vision": [N, 512], "touch": [N, 512]}
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import safetensors.torch
import torch
from PIL import Image
from torch import Tensor, nn

from mvitac.data.images import difference, fit
from mvitac.data.spec import DataSpec
from mvitac.methods.base import Method
from mvitac.nn.encoders import SCRATCH
from mvitac.nn.linear_probe import LinearProbe
from mvitac.registry import from_json, to_json, unknown
from mvitac.run import Run
from mvitac.system.files import brief, digest, write_atomic
from mvitac.transforms.random_views import plain_view

FORMAT = "mvitac-model"
EMBED_BATCH = 256
"""Images that ``Model.embed`` passes through an encoder at once."""
Images = np.ndarray | Tensor | Image.Image | Sequence[Any]


class Model(nn.Module):
    """Encoders modality -> trunk, projectors modality -> head, classifiers of tasks, in eval mode, with preprocessing."""

    def __init__(self, method: Method, run: Run, spec: DataSpec, stored: int) -> None:
        """``stored``: side in pixels at which the training pack stores images, to which raw ones are squashed first."""
        super().__init__()
        self.run, self.spec, self.stored = run, spec, stored
        self.encoders = nn.ModuleDict(method.encoders())
        self.projectors = nn.ModuleDict(method.projectors())
        own = method.classifiers()
        self.tasks = tuple(own)
        self.classifiers = nn.ModuleList(own.values())
        # No part of the state dict: a run's weights are the same with and without the probes that were published.
        self.readouts: dict[str, LinearProbe] = {}
        self.eval()

    @torch.no_grad()
    def features(self, modality: str, images: Tensor, *, for_heads: bool = False, bf16: bool = False) -> Tensor:
        """Pooled features [B, D] (fp32) of uint8 ``images`` [B, C, H, W] as a pack stores them.

        With ``for_heads`` those that ``project`` and ``classify`` want: at the side of the views the heads learned from,
        which may be smaller than the side that serves a probe best (``Augment.whole``).
        """
        view = plain_view(images, self.run.augment.size if for_heads else self.run.augment.eval_size)
        with torch.autocast(images.device.type, torch.bfloat16, enabled=bf16):
            return self.encoders[modality](view).float()

    @torch.no_grad()
    def project(self, modality: str, features: Tensor) -> Tensor:
        """Features [B, D], those ``for_heads``, into the space that both modalities share [B, E], L2-normalised."""
        if modality not in self.projectors:
            raise ValueError(f"this model has no shared space for {modality}: its method is {self.run.method.name!r}")
        return nn.functional.normalize(self.projectors[modality](features), dim=1)

    @torch.no_grad()
    def classify(self, task: str, features: dict[str, Tensor]) -> Tensor:
        """Class probabilities [B, K] by the classifier trained along with the encoders (supervised methods only).

        ``features`` are those ``for_heads``, by modality.
        """
        if task not in self.tasks:
            raise unknown("task of this model's own classifiers", task, self.tasks or ("none",))
        joined = torch.cat([features[m] for m in self.encoders], dim=1)
        return self.classifiers[self.tasks.index(task)](joined).softmax(dim=1)

    def embed(
        self,
        *,
        vision: Images | None = None,
        touch: Images | None = None,
        background: Images | None = None,
        shared: bool = False,
    ) -> dict[str, Tensor]:
        """Embed raw images: features [N, D] by modality, or with ``shared`` the L2-normalised common space [N, E].

        Each argument is one image or several: uint8 arrays [H, W, C] or [N, H, W, C], uint8 tensors [C, H, W] or
        [N, C, H, W], PIL images, or a list of these. A two-sensor touch image has 6 channels (left, then right). Any
        size: images are resized as the pack resized the training data. A model of difference images
        (``spec.difference``) also wants ``background``, the sensor without contact: one image, or one for each touch;
        without it touch is taken as (touch - background) / 2 + 128 already. ValueError names what does not fit.
        """
        given = {m: v for m, v in (("vision", vision), ("touch", touch)) if v is not None}
        if not given:
            raise ValueError("embed: give vision=..., touch=..., or both")
        if background is not None and (touch is None or not self.spec.difference):
            why = "there is no touch" if touch is None else "this model was not trained on difference images of touch"
            raise ValueError(f"background has no use here, {why}: leave it out")
        device = next(self.parameters()).device
        result = {}
        for modality, value in given.items():
            if modality not in self.encoders:
                raise ValueError(f"this model has no {modality} encoder: it has {', '.join(self.encoders)}")
            arrays = to_arrays(value, self.spec.channels(modality), modality)
            if modality == "touch" and background is not None:
                arrays = subtracted(arrays, to_arrays(background, self.spec.channels("touch"), "background"))
            chunks = []
            for i in range(0, len(arrays), EMBED_BATCH):
                batch = np.stack([fit(a, self.stored) for a in arrays[i : i + EMBED_BATCH]])
                images = torch.from_numpy(batch).permute(0, 3, 1, 2).to(device)
                features = self.features(modality, images, for_heads=shared)
                chunks.append(self.project(modality, features) if shared else features)
            result[modality] = torch.cat(chunks)
        return result

    def predict(
        self, *, vision: Images | None = None, touch: Images | None = None, background: Images | None = None
    ) -> dict[str, Tensor]:
        """Class probabilities [N, K] by task, from the probes that a published artifact carries.

        Images and ``background`` are as for ``embed``. Given both modalities, the probe on both answers. ``classes`` names
        the columns. ValueError as for ``embed``, and where there is no probe.
        """
        given = self.embed(vision=vision, touch=touch, background=background)
        asked = "both" if len(given) == 2 else next(iter(given))
        if len({len(x) for x in given.values()}) > 1:
            raise ValueError(f"predict: got {len(given['vision'])} vision and {len(given['touch'])} touch images")
        chosen = [r for r in self.readouts.values() if r.question.modality == asked]
        if not chosen:
            raise ValueError(f"this model has no probe on {asked}: load an artifact written by `mvitac publish`")
        return {r.question.task: r(torch.cat([given[m].cpu() for m in r.question.modalities], dim=1)) for r in chosen}

    @property
    def classes(self) -> dict[str, tuple[str, ...]]:
        """Class names by task, in the order of ``predict``'s columns."""
        return {r.question.task: r.question.classes for r in self.readouts.values()}

    def weights_digest(self) -> str:
        """Content address of the weights and of the view they expect, for caches."""
        tensors = {name: t.cpu().contiguous() for name, t in self.state_dict().items()}
        return digest([safetensors_digest(tensors), self.run.augment.eval_size])

    def save(self, path: Path) -> None:
        """Write ``path`` (.safetensors) with run and data description in its header."""
        tensors = {name: t.cpu().contiguous() for name, t in self.state_dict().items()}
        header = {
            "format": FORMAT,
            "run": json.dumps(to_json(self.run)),
            "spec": json.dumps(to_json(self.spec)),
            "stored": str(self.stored),
            "digest": safetensors_digest(tensors),
        }
        header["header_digest"] = digest([header["run"], header["spec"], header["stored"]])
        data = safetensors.torch.save(tensors, metadata=header)
        write_atomic(path, lambda file: file.write(data))


def safetensors_digest(tensors: dict[str, Tensor]) -> str:
    """sha256 over names, shapes and bytes."""
    import hashlib

    total = hashlib.sha256()
    for name in sorted(tensors):
        total.update(f"{name} {tuple(tensors[name].shape)} {tensors[name].dtype}\n".encode())
        total.update(tensors[name].reshape(-1).view(torch.uint8).numpy().tobytes())
    return total.hexdigest()


def fresh(run: Run, spec: DataSpec, stored: int) -> Model:
    """The model of ``run`` before any training, from its seed: the untrained control, and the frame weights load into."""
    torch.manual_seed(run.seed)
    return Model(run.method.build(spec, run.encoder), run, spec, stored)


def load(path: str | Path) -> Model:
    """A trained model from a run's folder or its model.safetensors; never unpickles; ValueError says what is wrong."""
    path = Path(path)
    file = path / "model.safetensors" if path.is_dir() else path
    if not file.is_file():
        hint = "; the run is not finished: `mvitac pretrain --resume`" if (path / "checkpoint.pt").exists() else ""
        raise ValueError(f"no trained model at {file}{hint}")
    try:
        with safetensors.safe_open(file, framework="pt") as opened:
            header = opened.metadata() or {}
            tensors = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118 - not a dict
    except Exception as error:  # safetensors raises its own kind for every damaged byte
        raise ValueError(f"{file} cannot be read as safetensors ({brief(error)}): copy it again or re-train") from None
    if header.get("format") != FORMAT:
        raise ValueError(f"{file} was not written by mvitac: its header lacks format={FORMAT}")
    if safetensors_digest(tensors) != header.get("digest"):
        raise ValueError(f"{file} does not match its digest: the weights were changed or damaged")
    given = digest([header.get("run"), header.get("spec"), header.get("stored")])
    if header.get("header_digest", given) != given:
        raise ValueError(f"{file} does not match its header's digest: it was changed or damaged")
    try:
        run = Run.load(json.loads(header["run"]))
        spec: DataSpec = from_json(DataSpec, json.loads(header["spec"]), "spec")
        stored = int(from_json(int, json.loads(header["stored"]), "stored"))
        # A model from before its header said so.
        spec = replace(spec, difference=spec.difference or bool(getattr(run.data, "difference", False)))
    except (KeyError, ValueError) as error:
        raise ValueError(f"{file} has a damaged header ({brief(error)}): copy it again or re-train") from None
    # The file holds every weight, so the frame needs none of its own, and must not reach for the network.
    frame = replace(run, encoder=replace(run.encoder, weights=SCRATCH))
    # Shapes before memory: a header of a few bytes may name a network that is larger than this machine.
    with torch.random.fork_rng(devices=[]):  # the caller's chance is not ours to draw from
        with torch.device("meta"):
            check_tensors(file, fresh(frame, spec, stored).state_dict(), tensors)
        model = fresh(frame, spec, stored)
    model.run = run
    model.load_state_dict(tensors)
    return model


def check_tensors(file: Path, expected: dict[str, Tensor], found: dict[str, Any]) -> None:
    """ValueError, naming the first tensor, if ``found`` in ``file`` are not the ``expected`` names and shapes."""
    for name in sorted(expected.keys() ^ found.keys()):
        where = "is missing" if name in expected else "does not belong"
        raise ValueError(f"{file} holds other weights than its run describes: tensor {name!r} {where}")
    for name, tensor in expected.items():
        if tensor.shape != found[name].shape:
            shapes = f"{tuple(found[name].shape)}, expected {tuple(tensor.shape)}"
            raise ValueError(f"{file} holds other weights than its run describes: {name!r} is {shapes}")


def precision_of(run: Run, record: dict[str, Any]) -> str:
    """What a recorded run computed in: what auto became on its machine. Older records hold none, nor runs that ask auto."""
    return record.get("precision", run.precision)


def to_arrays(value: Images, channels: int, what: str) -> list[np.ndarray]:
    """Whatever ``Model.embed`` accepts as uint8 arrays [H, W, channels]."""
    if isinstance(value, Image.Image):
        value = [value]
    if isinstance(value, (np.ndarray, Tensor)):
        value = list(value) if value.ndim == 4 else [value]  # a foreign shape is named below
    if isinstance(value, (str, bytes, dict)) or not isinstance(value, Iterable):
        raise ValueError(f"{what}: expected uint8 images with {channels} channels, got {type(value).__name__}")
    arrays = []
    for image in value:
        if isinstance(image, Image.Image):
            image = np.asarray(image.convert("RGB"))
        elif isinstance(image, Tensor):
            image = image.permute(1, 2, 0).cpu().numpy() if image.ndim == 3 else image.cpu().numpy()
        if not isinstance(image, np.ndarray) or image.dtype != np.uint8 or image.ndim != 3:
            shown = f"{image.dtype} {image.shape}" if isinstance(image, np.ndarray) else type(image).__name__
            raise ValueError(f"{what}: expected uint8 images with {channels} channels, got {shown}")
        if 0 in image.shape[:2]:
            raise ValueError(f"{what}: got an image of shape {image.shape}, which has no pixels")
        if image.shape[2] != channels:
            raise ValueError(f"{what}: this model takes {channels} channels, got an image of shape {image.shape}")
        arrays.append(image)
    if not arrays:
        raise ValueError(f"{what}: no images given")
    return arrays


def subtracted(touch: list[np.ndarray], background: list[np.ndarray]) -> list[np.ndarray]:
    """Difference images of ``touch``, each minus its own ``background`` or all minus the only one."""
    if len(background) not in (1, len(touch)):
        raise ValueError(
            f"background: got {len(background)} images for {len(touch)} of touch: give one, or one for each"
        )
    return [difference(image, background[i % len(background)]) for i, image in enumerate(touch)]


def check_modality(spec: DataSpec, modality: str) -> None:
    """Refuse a modality the dataset lacks."""
    if modality not in spec.modalities:
        raise unknown("modality", modality, spec.modalities)
