"""The trained model: encoders, heads into the shared space, and the preprocessing of raw images.

    model = mvitac.load("base")
    features = model.embed(vision=photos, touch=presses)      # {"vision": [N, 1280], "touch": [N, 512]}
    features = model(touch=batch)["touch"]                    # with gradients, for fine-tuning

Shapes: N or B images, C channels, H x W pixels, D features, E dimensions of the shared space, K classes.
"""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, get_args

import torch
from torch import Tensor, nn

from mvitac.data.pack import Pack
from mvitac.data.spec import DataSpec, Target, listed
from mvitac.methods.base import Method
from mvitac.nn.encoders import Seeded, num_features, timm_trunk
from mvitac.nn.linear_probe import LinearProbe, ProbeInfo, ValueInfo
from mvitac.nn.weights import misfit, read_model, safetensors_digest, write_model
from mvitac.registry import check_known, from_json, to_json
from mvitac.run import Run, load_run
from mvitac.system.files import brief, digest, parse_json
from mvitac.system.sealed_folder import ARTIFACT
from mvitac.transforms.preprocess import ImageInput, Preprocess, check_images, resized, to_array
from mvitac.transforms.random_views import normalise, plain_view

ABOUT = ("run", "spec", "stored")  # texts in the header of a file of weights
MAX_STORED = 1024  # px: no pack holds larger images (``data.storage``)
BEST = "model.best.safetensors"  # weights of a run that were best on split val, kept with ``Run.eval_every``
Which = Literal["last", "best"]
EMBED_BATCH = 64  # images that ``Model.embed`` passes through an encoder at once: 0.5 GB with ResNet-18 at 224 px


class Model(nn.Module):
    """The networks of a method that are kept after pre-training, in eval mode, with the preprocessing of their images.

    ``embed`` and ``predict`` take raw images and compute no gradients. ``forward`` takes tensors, for further training.

    ``stored`` is the side in pixels of the images in the training pack: raw images are first resized to it.

    Attributes:
        encoders: modality -> trunk.
        projectors: modality -> head into the shared space.
        tasks: Names of the tasks of the method's own heads (``classifiers``); empty for a self-supervised method.
        probes: Name -> linear probe, if the model is a published artifact.
        foreign: Whether it is from an artifact, which may be a stranger's: no place that ``run`` names is opened.
    """

    foreign = False
    thread_safe = True  # whether several threads may call one trunk at once: other people's may keep what they computed

    def __init__(self, method: Method, run: Run, spec: DataSpec, stored: int) -> None:
        super().__init__()
        self.run, self.spec, self.stored = run, spec, stored
        self.encoders = nn.ModuleDict(method.encoders())
        self.projectors = nn.ModuleDict(method.projectors())
        own = method.classifiers()
        self.tasks = tuple(own)
        self.classifiers = nn.ModuleList(own.values())
        # Not in the state dict: the weights of a run are the same with and without published probes.
        self.probes: dict[str, LinearProbe] = {}
        self.eval()

    @property
    def seed(self) -> int:
        return self.run.seed

    def image_sizes(self, modality: str) -> tuple[int, int]:
        """Sides in pixels of the images that probes, and heads trained along, see."""
        return self.run.augment.whole_of(modality), self.run.augment.size_of(modality)

    def mean_std(self, modality: str) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Mean and standard deviation, of R, G and B in [0, 1], by which images are normalised."""
        return self.run.encoder[modality].mean_std

    def input(self, modality: str, images: Tensor, *, for_heads: bool = False) -> Tensor:
        """The normalised images [B, C, S, S] that an encoder takes, of uint8 or floats in [0, 1], with their gradients."""
        size, mean_std = self.image_sizes(modality)[for_heads], self.mean_std(modality)
        if images.dtype == torch.uint8:
            return plain_view(images, size, mean_std)
        return normalise(resized(images.float(), size), mean_std)

    def __repr__(self) -> str:
        widths = ", ".join(f"{modality} {num_features(trunk)}" for modality, trunk in self.encoders.items())
        method, trunk = self.run.method.name, self.run.encoder.named(self.encoders)
        named = self.spec.sensors not in ((), (self.spec.name,))
        sensors = f" (touch sensors {listed(self.spec.sensors)})" if named else ""
        return f"Model({method} of {trunk}, trained on {self.spec.name}{sensors}: features {widths})"

    def forward(
        self, *, vision: Tensor | None = None, touch: Tensor | None = None, shared: bool = False
    ) -> dict[str, Tensor]:
        """Features of batches of images, with gradients, for fine-tuning.

        The features are those of ``embed``. The model is in eval mode until ``train()``: BatchNorm keeps statistics.

        Args:
            vision: Camera images [B, C, H, W], uint8 or float in [0, 1], e.g. a batch of ``transform("vision")``.
            touch: Tactile images, likewise. For models trained on difference images: the differences.
            shared: Return embeddings in the space shared by both modalities, L2-normalised, instead of features.

        Returns modality -> [B, D], or [B, E] with ``shared``; ValueError if images do not fit the model.
        """
        result = {}
        for modality, images in self._named(vision=vision, touch=touch).items():
            images = check_images(images, self.spec.channels(modality), modality)
            features = self._encode(modality, resized(images, self.stored), shared)
            result[modality] = self._project(modality, features) if shared else features
        return result

    def _named(self, **images: Any) -> dict[str, Any]:
        if not (given := {modality: value for modality, value in images.items() if value is not None}):
            raise ValueError("no images given: give vision=..., touch=..., or both")
        for modality in given:
            self.check_modality(modality)
        return given

    def check_modality(self, modality: str) -> None:
        """Raise ValueError unless the model has an encoder for ``modality``."""
        if modality not in self.encoders:
            raise ValueError(f"this model has no {modality} encoder: it has {', '.join(self.encoders)}")

    def _encode(self, modality: str, images: Tensor, for_heads: bool) -> Tensor:
        return self.encoders[modality](self.input(modality, images, for_heads=for_heads)).float()

    def _project(self, modality: str, features: Tensor) -> Tensor:
        if modality not in self.projectors:
            raise ValueError(f"this model has no shared space for {modality}: its method is {self.run.method.name!r}")
        return nn.functional.normalize(self.projectors[modality](features), dim=1)

    def transform(self, modality: str, *, normalize: bool = False, background: ImageInput | None = None) -> Preprocess:
        """The preprocessing of one image as a function, e.g. for the dataset of a ``DataLoader``.

        The function can be pickled. It returns what ``forward`` takes, uint8 [C, stored, stored], or with ``normalize`` what
        ``trunk`` takes, fp32 [C, S, S]. ``background``, for models trained on difference images, is the sensor without
        contact, one image, to subtract.
        """
        self.check_modality(modality)
        self._check_background(modality, background)
        channels, size = self.spec.channels(modality), self.image_sizes(modality)[0] if normalize else None
        frames = self.spec.frames(modality)
        free = None if background is None else to_array(background, channels // frames, "background")
        return Preprocess(modality, channels, self.stored, size, free, frames, self.mean_std(modality))

    def trunk(self, modality: str) -> nn.Module:
        """A copy of one encoder as a plain timm model, from normalised images [B, C, S, S] to features [B, D].

        Its ``pretrained_cfg`` has the input size, mean and std that ``timm.data.resolve_model_data_config`` reads.
        ValueError if the model has no such encoder, or it is not a single timm model.
        """
        self.check_modality(modality)
        channels, size = self.spec.channels(modality), self.image_sizes(modality)[0]
        mean, std = (values * (channels // 3) for values in self.mean_std(modality))
        return timm_trunk(self.encoders[modality], self.run.encoder[modality].trunk, (channels, size, size), mean, std)

    @torch.no_grad()
    def features(self, modality: str, images: Tensor, *, for_heads: bool = False, bf16: bool = False) -> Tensor:
        """Pooled features [B, D], fp32, of images from a pack, without gradients.

        ``images`` are uint8 [B, C, H, W], as a pack stores them, or floats in [0, 1]. ``for_heads``: the features that
        ``project`` and ``answer`` take, which see images at the size of the training views (``Augment.size``), while
        probes see them at ``Augment.whole``.
        """
        images = check_images(images, self.spec.channels(modality), modality)
        with torch.autocast(images.device.type, torch.bfloat16, enabled=bf16):
            return self._encode(modality, images, for_heads)

    @torch.no_grad()
    def project(self, modality: str, features: Tensor) -> Tensor:
        """Map ``features(..., for_heads=True)`` [B, D] into the shared space [B, E]; L2-normalised."""
        return self._project(modality, features)

    @torch.no_grad()
    def answer(self, task: str, features: dict[str, Tensor]) -> Tensor:
        """Class probabilities [B, K], or values [B, T] in their units, from a head trained along by a supervised method.

        ``task`` is one of ``tasks``; ``features``: modality -> ``features(..., for_heads=True)``.
        """
        found = self.classifiers[self.tasks.index(task)](torch.cat([features[m] for m in self.encoders], dim=1))
        return found.softmax(dim=1) if task in {task.name for task in self.spec.tasks} else found

    def embed(
        self,
        *,
        vision: ImageInput | None = None,
        touch: ImageInput | None = None,
        background: ImageInput | None = None,
        shared: bool = False,
    ) -> dict[str, Tensor]:
        """Embed raw images, without gradients and in batches: memory does not grow with their number.

        An image is a path, a PIL image, an array [H, W, C] or a tensor [C, H, W] or [H, W, C]. Arrays and tensors are
        uint8 or float in [0, 1], RGB. Several images are a list of these, an array [N, H, W, C], or a tensor [N, C, H, W]
        or [N, H, W, C]. They may have any size: they are resized like the training images. If those were cropped, cut the
        part out first (``spec.crop``, x:y:width:height).

        A model of windows (``spec.window``) takes clips: [F, H, W, C], oldest first, or a list of F images; several are a
        list of clips or an array [N, F, H, W, C]. Frames are ``spec.window.stride`` apart.

        Args:
            vision: Camera images.
            touch: Tactile images. With two sensors they have 6 channels, left before right.
            background: For models trained on difference images (``spec.difference``): the sensor without contact, as one
                image or one per touch image; for windows minus their touch's first frame: that frame. Without it,
                ``touch`` must already be (touch - background) / 2 + 128.
            shared: Return embeddings in the space shared by both modalities, L2-normalised, instead of features.

        Returns modality -> [N, D], or [N, E] with ``shared``; ValueError in training mode, or if images do not fit.

        Examples:
            >>> model.embed(touch=np.zeros((4, 240, 320, 3), np.uint8))["touch"].shape  # doctest: +SKIP
            torch.Size([4, 512])
        """
        if any(module.training for module in self.modules()):
            raise ValueError("the model is in training mode, which would change BatchNorm: call model.eval() first")
        given = self._named(vision=vision, touch=touch)
        self._check_background("touch" if touch is not None else "vision", background)
        device, found = next(self.parameters()).device, {}
        for modality, value in given.items():
            chunks, own = [], background if modality == "touch" else None
            for batch in self.transform(modality).batches(value, own, EMBED_BATCH):
                features = self.features(modality, batch.to(device), for_heads=shared)
                chunks.append(self.project(modality, features) if shared else features)
            found[modality] = torch.cat(chunks)
        return found

    def _check_background(self, modality: str, background: ImageInput | None) -> None:
        first = self.spec.window.minus_first and "touch" in self.spec.window.of
        if background is not None and (modality != "touch" or self.spec.difference == first):
            raise ValueError("background cannot be used: only touch minus a background or its first frame has one")

    def predict(
        self, *, vision: ImageInput | None = None, touch: ImageInput | None = None, background: ImageInput | None = None
    ) -> dict[str, Tensor]:
        """Classify or measure raw images with the probes of a published artifact.

        Images are given as for ``embed``. If both modalities are given, the probes on both are used.

        Returns task -> class probabilities [N, K], or values [N, T] in the units of their targets; ``classes`` and
        ``targets`` name the columns. ValueError as for ``embed``, or if the model has no probe on these modalities.
        """
        given = self.embed(vision=vision, touch=touch, background=background)
        if len({len(features) for features in given.values()}) > 1:
            numbers = " and ".join(f"{len(features)} of {modality}" for modality, features in given.items())
            raise ValueError(f"{numbers} are no pairs: give as many images of each, or one modality")
        asked = "both" if len(given) == 2 else next(iter(given))
        if not (chosen := [r for r in self.probes.values() if r.info.modality == asked]):
            how = "load an artifact that `mvitac publish` wrote with labelled data"
            raise ValueError(f"this model has no probe on {asked}: {how}")
        return {r.info.task: r(torch.cat([given[m].cpu() for m in r.info.modalities], dim=1)) for r in chosen}

    @property
    def classes(self) -> dict[str, tuple[str, ...]]:
        """task -> class names, in the order of the columns of ``predict``."""
        return {q.task: q.classes for r in self.probes.values() if isinstance(q := r.info, ProbeInfo)}

    @property
    def targets(self) -> dict[str, tuple[Target, ...]]:
        """task -> names and units of its values, in the order of the columns of ``predict``."""
        return {q.task: q.targets for r in self.probes.values() if isinstance(q := r.info, ValueInfo)}

    def open_data(self, *, quiet: bool = False) -> Pack:
        """Open the data that the model was trained on; ValueError if it is not here, or ``foreign`` names its place."""
        if self.foreign and self.run.data.names_a_place:
            raise ValueError("an artifact may be a stranger's: its data is not opened by its path, probe it --on PACK")
        return self.run.data.open(quiet=quiet)

    def weights_digest(self) -> str:
        """Content address of the weights and of the image size they expect, for caches."""
        sizes = dict.fromkeys(self.image_sizes(m)[0] for m in self.encoders)
        return digest([safetensors_digest(tensors_of(self)), *sizes])

    def features_key(self, modality: str) -> str:
        """Content address of what the features of ``modality`` depend on. Models that share a tower share it."""
        encoder, size = self.run.encoder[modality], self.image_sizes(modality)[0]
        kind = encoder.trunk, encoder.temporal, encoder.pool, self.mean_std(modality), size, self.stored
        return digest([safetensors_digest(tensors_of(self.encoders[modality])), *kind])

    def save(self, path: Path, *, half: bool = False) -> None:
        """Write a .safetensors file with the run and the description of the data in its header.

        ``half``: kernels and matrices in fp16, which halves the file. They are fp32 again once loaded.
        """
        tensors = {name: t.half() if half and t.ndim > 1 else t for name, t in tensors_of(self).items()}
        about = json.dumps(to_json(self.run)), json.dumps(to_json(self.spec)), str(self.stored)
        write_model(path, tensors, dict(zip(ABOUT, about, strict=True)))


def tensors_of(network: nn.Module) -> dict[str, Tensor]:
    return {name: tensor.cpu().contiguous() for name, tensor in network.state_dict().items()}


def weights_file(folder: Path, which: Which) -> Path:
    """The file of a run's weights; ValueError if the best ones were not kept."""
    check_known("weights", [which], get_args(Which))
    if which == "best" and not (folder / BEST).is_file():
        raise ValueError(f"{folder} has no {BEST}: train with --eval-every N to keep the best weights, or use the last")
    return folder / (BEST if which == "best" else "model.safetensors")


def fresh(run: Run, spec: DataSpec, stored: int) -> Model:
    """The model of ``run`` before training, initialised from its seed. Used as a control, and to load weights into."""
    with Seeded(run.seed):
        return Model(run.method.build(spec, run.encoder), run, spec, stored)


def load(path: str | Path, which: Which = "last") -> Model:
    """Load a trained model from the folder of a run or from its model.safetensors. Never unpickles.

    ``which`` weights of a folder: those after its last step, or the best on split val (``Run.eval_every``). ValueError if
    there is no such model, or the file is damaged or was changed.
    """
    path = Path(path)
    file = weights_file(path, which) if path.is_dir() else path
    if not file.is_file():
        hint = "; the run is not finished: `mvitac pretrain --resume`" if (path / "checkpoint.pt").exists() else ""
        if inside := sorted(file.parent for file in path.glob("*/model.safetensors")):
            hint = f"; there is one at {inside[0]}"
        raise ValueError(f"no trained model at {file}{hint}")
    if foreign := (file.parent / ARTIFACT.name).exists():
        ARTIFACT.read(file.parent)
    header, tensors = read_model(file, ABOUT)
    try:
        run = Run.load(parse_json(header["run"]))
        spec: DataSpec = from_json(DataSpec, parse_json(header["spec"]), "spec")
        stored = int(from_json(int, parse_json(header["stored"]), "stored"))
        if not 1 <= stored <= MAX_STORED:
            raise ValueError(f"stored {stored}: expected 1 to {MAX_STORED} px")
    except (KeyError, ValueError) as error:
        if str(error).startswith("unknown method"):
            raise ValueError(f"{file}: {error}; one of your own is known once its module is imported") from None
        raise ValueError(f"{file} has a damaged header ({brief(error)}): copy it again or re-train") from None
    beside = file.with_name("run.json")  # and with it the list of rows that the run learned from
    own = run if foreign or not beside.exists() else replace(load_run(beside)[0], precision=run.precision)
    if own is not run and own.digest() != run.digest():
        raise ValueError(f"{file} is of another run than {beside}: put it elsewhere")
    # The file has all weights, so the empty model needs no pretrained ones, and no download.
    empty = run.fresh()
    # Check shapes before allocating: a damaged header may describe a network larger than the memory.
    with torch.device("meta"):
        if why := misfit(fresh(empty, spec, stored).state_dict(), tensors):
            raise ValueError(f"{file} holds other weights than its run describes: {why}")
    model = fresh(empty, spec, stored)
    model.foreign = foreign
    if model.foreign and run.init:
        run = replace(run, init=replace(run.init, path=None, digest=run.init.digest or "unknown"))
    model.run = run
    model.load_state_dict(tensors)
    return model
