"""The trained model: frozen encoders, heads into the shared space, and the preprocessing of raw images.

    model = mvitac.load("runs/demo/seed0")
    features = model.embed(vision=photos, touch=presses)      # {"vision": [N, 512], "touch": [N, 512]}

Shapes: N or B images, C channels, H x W pixels, D features, E dimensions of the shared space, K classes.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import replace
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import safetensors.torch
import torch
from PIL import Image
from torch import Tensor, nn

from mvitac.data.images import difference, fit
from mvitac.data.notebook import table
from mvitac.data.spec import DataSpec
from mvitac.methods.base import Method
from mvitac.nn.encoders import SCRATCH, num_features
from mvitac.nn.linear_probe import LinearProbe
from mvitac.registry import from_json, to_json, unknown
from mvitac.run import Run
from mvitac.system.files import brief, digest, write_atomic
from mvitac.transforms.random_views import plain_view

FORMAT = "mvitac-model"
ImageInput = np.ndarray | Tensor | Image.Image | Sequence[Any]
"""One image or several, as ``Model.embed`` accepts them."""
EMBED_BATCH = 256
"""Images that ``Model.embed`` passes through an encoder at once."""


class Model(nn.Module):
    """The networks of a method that are kept after pre-training, in eval mode, with the preprocessing of their images.

    Args:
        method: The method, trained or not.
        run: The run that trains it.
        spec: Description of the training data.
        stored: Side in pixels of the images in the training pack. Raw images are first resized to it.

    Attributes:
        encoders: modality -> trunk.
        projectors: modality -> head into the shared space.
        tasks: Names of the tasks of the method's own ``classifiers``; empty for a self-supervised method.
        readouts: Name -> linear probe, if the model is a published artifact.
    """

    def __init__(self, method: Method, run: Run, spec: DataSpec, stored: int) -> None:
        super().__init__()
        self.run, self.spec, self.stored = run, spec, stored
        self.encoders = nn.ModuleDict(method.encoders())
        self.projectors = nn.ModuleDict(method.projectors())
        own = method.classifiers()
        self.tasks = tuple(own)
        self.classifiers = nn.ModuleList(own.values())
        # Not in the state dict: the weights of a run are the same with and without published probes.
        self.readouts: dict[str, LinearProbe] = {}
        self.eval()

    def __repr__(self) -> str:
        widths = ", ".join(f"{modality} {num_features(trunk)}" for modality, trunk in self.encoders.items())
        method, trunk = self.run.method.name, self.run.encoder.trunk
        return f"Model({method} of {trunk}, trained on {self.spec.name}: features {widths})"

    def _repr_html_(self) -> str:
        rows = [(modality, num_features(trunk)) for modality, trunk in self.encoders.items()]
        probes = [(task, ", ".join(classes)) for task, classes in self.classes.items()]
        text = f"<p>{escape(repr(self))}</p>{table(rows, ('input', 'features'))}"
        return text + (table(probes, ("probe", "classes")) if probes else "")

    @torch.no_grad()
    def features(self, modality: str, images: Tensor, *, for_heads: bool = False, bf16: bool = False) -> Tensor:
        """Pooled features of images from a pack.

        Args:
            modality: vision or touch.
            images: uint8 [B, C, H, W], as a pack stores them.
            for_heads: Compute the features that ``project`` and ``classify`` take. They see images at the size of the
                training views (``Augment.size``), while probes see them at ``Augment.whole``.
            bf16: Compute in bf16.

        Returns:
            [B, D], fp32.
        """
        view = plain_view(images, self.run.augment.size if for_heads else self.run.augment.eval_size)
        with torch.autocast(images.device.type, torch.bfloat16, enabled=bf16):
            return self.encoders[modality](view).float()

    @torch.no_grad()
    def project(self, modality: str, features: Tensor) -> Tensor:
        """Map ``features(..., for_heads=True)`` [B, D] into the shared space [B, E]; L2-normalised."""
        if modality not in self.projectors:
            raise ValueError(f"this model has no shared space for {modality}: its method is {self.run.method.name!r}")
        return nn.functional.normalize(self.projectors[modality](features), dim=1)

    @torch.no_grad()
    def classify(self, task: str, features: dict[str, Tensor]) -> Tensor:
        """Class probabilities [B, K] from the classifier that a supervised method trained with its encoders.

        Args:
            task: One of ``tasks``.
            features: modality -> ``features(..., for_heads=True)``.
        """
        if task not in self.tasks:
            raise unknown("task of this model's own classifiers", task, self.tasks or ("none",))
        joined = torch.cat([features[m] for m in self.encoders], dim=1)
        return self.classifiers[self.tasks.index(task)](joined).softmax(dim=1)

    def embed(
        self,
        *,
        vision: ImageInput | None = None,
        touch: ImageInput | None = None,
        background: ImageInput | None = None,
        shared: bool = False,
    ) -> dict[str, Tensor]:
        """Embed raw images.

        Images are uint8 arrays [H, W, C] or [N, H, W, C], uint8 tensors [C, H, W] or [N, C, H, W], PIL images, or a list of
        these. They may have any size: they are resized like the training images.

        Args:
            vision: Camera images.
            touch: Tactile images. With two sensors they have 6 channels, left before right.
            background: For models trained on difference images (``spec.difference``): the sensor without contact, as one
                image or one per touch image. Without it, ``touch`` must already be (touch - background) / 2 + 128.
            shared: Return embeddings in the space shared by both modalities, L2-normalised, instead of features.

        Returns:
            modality -> [N, D], or [N, E] with ``shared``.

        Raises:
            ValueError: If images do not fit the model.

        Example:
            >>> model.embed(touch=np.zeros((4, 240, 320, 3), np.uint8))["touch"].shape  # doctest: +SKIP
            torch.Size([4, 512])
        """
        given = {m: v for m, v in (("vision", vision), ("touch", touch)) if v is not None}
        if not given:
            raise ValueError("embed: give vision=..., touch=..., or both")
        if background is not None and (touch is None or not self.spec.difference):
            why = "there is no touch" if touch is None else "this model was not trained on difference images of touch"
            raise ValueError(f"background cannot be used, {why}: leave it out")
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
        self, *, vision: ImageInput | None = None, touch: ImageInput | None = None, background: ImageInput | None = None
    ) -> dict[str, Tensor]:
        """Classify raw images with the probes of a published artifact.

        Args:
            vision: As for ``embed``. If both modalities are given, the probes on both are used.
            touch: As for ``embed``.
            background: As for ``embed``.

        Returns:
            task -> class probabilities [N, K]. ``classes`` names the columns.

        Raises:
            ValueError: As for ``embed``, or if the model has no probe on these modalities.
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
        """task -> class names, in the order of the columns of ``predict``."""
        return {r.question.task: r.question.classes for r in self.readouts.values()}

    def weights_digest(self) -> str:
        """Content address of the weights and of the image size they expect, for caches."""
        tensors = {name: t.cpu().contiguous() for name, t in self.state_dict().items()}
        return digest([safetensors_digest(tensors), self.run.augment.eval_size])

    def save(self, path: Path) -> None:
        """Write a .safetensors file with the run and the description of the data in its header."""
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
    """sha256 of names, shapes, types and values."""
    import hashlib

    total = hashlib.sha256()
    for name in sorted(tensors):
        total.update(f"{name} {tuple(tensors[name].shape)} {tensors[name].dtype}\n".encode())
        total.update(tensors[name].reshape(-1).view(torch.uint8).numpy().tobytes())
    return total.hexdigest()


def fresh(run: Run, spec: DataSpec, stored: int) -> Model:
    """The model of ``run`` before training, initialised from its seed. Used as a control, and to load weights into."""
    torch.manual_seed(run.seed)
    return Model(run.method.build(spec, run.encoder), run, spec, stored)


def load(path: str | Path) -> Model:
    """Load a trained model from the folder of a run or from its model.safetensors. Never unpickles.

    Raises:
        ValueError: If there is no such model, or the file is damaged or was changed.
    """
    path = Path(path)
    file = path / "model.safetensors" if path.is_dir() else path
    if not file.is_file():
        hint = "; the run is not finished: `mvitac pretrain --resume`" if (path / "checkpoint.pt").exists() else ""
        raise ValueError(f"no trained model at {file}{hint}")
    try:
        with safetensors.safe_open(file, framework="pt") as opened:
            header = opened.metadata() or {}
            tensors = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118 - not a dict
    except Exception as error:  # safetensors raises several types for damaged files
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
        # Older headers have no spec.difference; it is in the data config.
        spec = replace(spec, difference=spec.difference or bool(getattr(run.data, "difference", False)))
    except (KeyError, ValueError) as error:
        raise ValueError(f"{file} has a damaged header ({brief(error)}): copy it again or re-train") from None
    # The file has all weights, so the empty model needs no pretrained ones, and no download.
    empty = replace(run, encoder=replace(run.encoder, weights=SCRATCH))
    # Check shapes before allocating: a damaged header may describe a network larger than the memory.
    with torch.random.fork_rng(devices=[]):  # keep the caller's random state
        with torch.device("meta"):
            check_tensors(file, fresh(empty, spec, stored).state_dict(), tensors)
        model = fresh(empty, spec, stored)
    model.run = run
    model.load_state_dict(tensors)
    return model


def check_tensors(file: Path, expected: dict[str, Tensor], found: dict[str, Any]) -> None:
    """Raise ValueError if the tensors ``found`` in ``file`` do not have the ``expected`` names and shapes."""
    for name in sorted(expected.keys() ^ found.keys()):
        where = "is missing" if name in expected else "does not belong"
        raise ValueError(f"{file} holds other weights than its run describes: tensor {name!r} {where}")
    for name, tensor in expected.items():
        if tensor.shape != found[name].shape:
            shapes = f"{tuple(found[name].shape)}, expected {tuple(tensor.shape)}"
            raise ValueError(f"{file} holds other weights than its run describes: {name!r} is {shapes}")


def precision_of(run: Run, record: dict[str, Any]) -> str:
    """The precision that a recorded run was computed in, with ``auto`` resolved. Older records have no such entry."""
    return record.get("precision", run.precision)


def to_arrays(value: ImageInput, channels: int, what: str) -> list[np.ndarray]:
    """Convert any input of ``Model.embed`` to uint8 arrays [H, W, channels]. ``what`` names it in errors."""
    if isinstance(value, Image.Image):
        value = [value]
    if isinstance(value, (np.ndarray, Tensor)):
        value = list(value) if value.ndim == 4 else [value]  # other shapes are refused below
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
    """Difference images of ``touch``: each minus its own ``background``, or all minus a single one."""
    if len(background) not in (1, len(touch)):
        raise ValueError(
            f"background: got {len(background)} images for {len(touch)} of touch: give one, or one for each"
        )
    return [difference(image, background[i % len(background)]) for i, image in enumerate(touch)]
