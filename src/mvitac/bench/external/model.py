"""Encoders of other people as models: ``mvitac.load("external:...")`` and ``mvitac probe --encoder external:...``.

model = mvitac.load("external:timm/vit_tiny_patch16_224,weights=random")
model, pack = model.on(mvitac.Pack("packs/materials"))     # for the channels, frames and backgrounds of this data
records = probe_model(model, pack, pack.spec.all_tasks, ["touch"], ["linear"])
"""

import copy
import hashlib
from dataclasses import replace
from typing import Any, NoReturn

import torch
from torch import Tensor, nn

from mvitac.bench.external.adapters import ABOUT, NOTHING, RANDOM, UNKNOWN, Adapter, Loaded, Timm, parse
from mvitac.data.pack import Pack
from mvitac.data.spec import DataSpec, Window
from mvitac.data.windows import windowed
from mvitac.model import Model
from mvitac.registry import to_json
from mvitac.system.files import brief, digest_file

PICTURES = DataSpec(
    name="images", vision_channels=3, touch_channels=3, tasks=(), group_by="image", licence=UNKNOWN, source=UNKNOWN
)  # what an encoder is for until it is bound to data: single images


class ExternalEncoder(nn.Module):
    """Features [B, S D] of raw images [B, C, H, W], uint8 or float in [0, 1]. Several sensors are encoded one by one.

    ``loaded`` is what ``adapter`` opened. ValueError if the network does not take such images.
    """

    def __init__(self, adapter: Adapter, loaded: Loaded) -> None:
        super().__init__()
        self.adapter, self.loaded, self.sensors, self.frames = adapter, loaded, 1, 1
        self.network = loaded.network.eval().requires_grad_(False)
        sized = {} if adapter.size is None else {"size": (adapter.size, adapter.size)}
        self.preprocessing = replace(loaded.preprocessing, **sized)
        digests = [digest_file(file) for file in loaded.files]
        known = hashlib.sha256(f"{adapter.place} {self.preprocessing} {digests}".encode()).digest()
        # A parameter, so that digests of the weights cover it and networks without weights have a device.
        self.identity = nn.Parameter(torch.frombuffer(bytearray(known), dtype=torch.uint8), requires_grad=False)
        shape = (3 * self.preprocessing.frames, *self.preprocessing.size)
        try:
            with torch.no_grad():
                found = self.network(torch.zeros(2, *shape))
            if found.ndim != 2 or len(found) != 2 or not found.shape[1] or found.is_complex():
                kind = f"{list(found.shape)} of {found.dtype}"
                raise ValueError(f"it returns {kind} for two images, not [2, D] of floats")
        except (Exception, SystemExit) as error:  # whatever the network raises
            why = f"the network does not take images {list(shape)} ({brief(error)})"
            raise ValueError(f"{adapter.place}: {why}: give its size and frames") from None
        self.num_features = self.width = found.shape[1]

    def bound(self, sensors: int, frames: int) -> "ExternalEncoder":
        """The same encoder, with the same weights, for images [B, frames x sensors x 3, H, W], newest frame first."""
        made = copy.copy(self)
        made.sensors, made.frames, made.num_features = sensors, frames, self.width * sensors
        return made

    def untrained(self) -> "ExternalEncoder | None":
        """The same network with random weights; None if it has no weights here, or random ones already."""
        if self.loaded.trained_on == NOTHING or not any(p.is_floating_point() for p in self.network.parameters()):
            return None
        network = randomised(self.network, self.adapter.seed)
        random = replace(self.loaded, network=network, files=(), licence=RANDOM, trained_on=NOTHING)
        return ExternalEncoder(self.adapter, random)

    def forward(self, images: Tensor) -> Tensor:
        each = images.unflatten(1, (self.frames, self.sensors, 3)).transpose(1, 2).flatten(0, 1)  # [B S, F, 3, H, W]
        found = self.network(self.preprocessing(each)).float().clone()  # whose memory may be the network's own
        return found.unflatten(0, (-1, self.sensors)).flatten(1)


def randomised(network: nn.Module, seed: int) -> nn.Module:
    """A copy of ``network`` with random weights: matrices truncated normal (.02), convolutions He, scales 1, biases 0."""
    network, generator = copy.deepcopy(network), torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for name, weight in network.named_parameters():
            if weight.ndim > 3:
                nn.init.kaiming_normal_(weight, generator=generator)
            elif weight.ndim > 1:
                nn.init.trunc_normal_(weight, std=0.02, generator=generator)
            else:
                weight.fill_(not name.endswith("bias"))
        for name, value in network.named_buffers():
            if name.endswith(("running_mean", "running_var")):
                value.fill_(name.endswith("var"))
    return network


class ExternalModel(Model):
    """A frozen encoder with the interface of ``Model`` that probes, features and ``embed`` use.

    There is no run, no shared space and no own head. ``text`` named the encoder; ``parts``: modality -> the opened one,
    bound to its images; ``notes``: what the data lacks that it wants.
    """

    def __init__(
        self, text: str, part: ExternalEncoder, spec: DataSpec = PICTURES, stored: int = 0, notes: tuple[str, ...] = ()
    ) -> None:
        nn.Module.__init__(self)
        self.text, self.spec, self.notes, self.name = text, spec, notes, part.loaded.title
        self.parts: dict[str, ExternalEncoder] = {}
        for modality in (m for m in spec.modalities if part.adapter.reads in (m, "both")):
            sensors = max(1, spec.channels(modality) // 3 // spec.frames(modality))
            self.parts[modality] = part.bound(sensors, spec.frames(modality))
        self.thread_safe = isinstance(part.adapter, Timm)
        self.alone: set[str] = set()  # modalities whose features were seen to be those of one image alone
        self.stored = stored or max(part.preprocessing.size)
        self.encoders = nn.ModuleDict(self.parts)
        self.projectors, self.classifiers, self.tasks, self.probes = nn.ModuleDict(), nn.ModuleList(), (), {}
        self.eval()

    def __repr__(self) -> str:
        return f"ExternalModel({self.title}: {', '.join(f'{m} {e.num_features}' for m, e in self.parts.items())})"

    @property
    def run(self) -> NoReturn:  # type: ignore[override]
        raise ValueError(f"{self.text} has no run here: use it with `mvitac probe --encoder` or `embed`")

    @property
    def seed(self) -> int:
        return self.part.adapter.seed

    @property
    def part(self) -> ExternalEncoder:
        """The encoder, as one of the modalities that it reads has it."""
        return next(iter(self.parts.values()))

    def image_sizes(self, modality: str) -> tuple[int, int]:
        side = max(self.part.preprocessing.size)
        return side, side

    def mean_std(self, modality: str) -> tuple[tuple[float, ...], tuple[float, ...]]:
        return self.part.preprocessing.mean, self.part.preprocessing.std

    @property
    def title(self) -> str:
        """Its name in tables; (NC): the licence allows no commercial use."""
        return self.name + " (NC)" * is_noncommercial(self.part.loaded.licence)

    @property
    def trained_on(self) -> str:
        """What it was trained on, as far as it is known; "nothing" for random weights."""
        return self.part.loaded.trained_on

    def on(self, pack: Pack) -> "tuple[ExternalModel, Pack]":
        """This model and ``pack``, for each other; ValueError if the data has no image that this model reads.

        The pack gets windows if an encoder wants several frames, the pack can order its frames, and it has no windows yet.
        """
        if not (modalities := tuple(m for m in self.parts if m in pack.spec.modalities)):
            known = f"{' and '.join(self.parts)}, {pack.spec.name!r} has {', '.join(pack.spec.modalities)}"
            raise ValueError(f"{self.text} reads {known}: give reads=touch, vision or both")
        notes: tuple[str, ...] = ()
        want = self.part.preprocessing
        if want.frames > 1 and not pack.spec.window.active:
            try:
                pack = windowed(pack, Window(frames=want.frames, stride=want.stride, of=modalities))
            except ValueError as error:
                notes = (f"the current frame is repeated ({error})",)
        return ExternalModel(self.text, self.part, pack.spec, pack.size, notes), pack

    def untrained(self) -> "ExternalModel | None":
        """The same network with random weights, as a control; None where that is not possible."""
        if (part := self.part.untrained()) is None:
            return None
        made = ExternalModel(self.text, part, self.spec, self.stored)
        made.name = f"{self.name}, untrained"
        return made

    def _encode(self, modality: str, images: Tensor, for_heads: bool) -> Tensor:
        try:
            found = self.encoders[modality](images)
        except Exception as error:  # whatever other people's code raises
            raise ValueError(f"{self.text} fails on {len(images)} images of {modality} ({brief(error)})") from None
        if not torch.isfinite(found).all():
            raise ValueError(f"{self.text} gives NaN or infinite features of {modality}: check weights, mean and std")
        # float32 must hold the squares of the smaller ones.
        if not (found == 0).all() and not 1e-3 < found.abs().max() < 1e12:
            largest = f"features of {modality} up to {found.abs().max():.0e}"
            raise ValueError(f"{self.text} gives {largest}: scale them to about 1")
        if not self.training and len(images) > 2 and modality not in self.alone:
            self.alone.add(modality)  # once: BatchNorm or dropout may still be that of training
            fewer = self.encoders[modality](images[:2])
            if fewer.shape[1] != found.shape[1] or (fewer - found[:2]).abs().max() > 0.02 * found.abs().max():
                raise ValueError(f"{self.text}: features of {modality} depend on the other images, or on chance")
        return found

    def features_key(self, modality: str) -> str:
        return self.weights_digest() + self.part.loaded.code

    def describe(self) -> dict[str, Any]:
        """What is needed to repeat and to judge the scores, JSON-ready."""
        known = {"encoder": self.text, "title": self.title, "seed": self.seed, "weights": self.weights_digest()}
        encoders = {modality: _described(part) for modality, part in self.parts.items()}
        return {**known, "notes": list(self.notes), "encoders": encoders}


def _described(part: ExternalEncoder) -> dict[str, Any]:
    loaded = part.loaded
    return {
        **{name: getattr(loaded, name) for name in ABOUT},
        "noncommercial": is_noncommercial(loaded.licence),
        "files": {file.name: digest_file(file) for file in loaded.files},
        "parameters": sum(p.numel() for p in loaded.network.parameters()),
        "features": part.num_features,
        "preprocessing": to_json(part.preprocessing),
    }


def is_noncommercial(licence: str) -> bool:
    return "nc" in licence.lower().split(" (")[0].replace("_", "-").split("-")


def open_model(text: str) -> ExternalModel:
    """Open the encoder that ``text`` names; ValueError if that is not possible."""
    adapter = parse(text)
    loaded = adapter.load()
    if adapter.trained_on and loaded.trained_on == NOTHING:
        raise ValueError(f"{text}: random weights are trained on nothing: leave trained-on out")
    given = {name: getattr(adapter, name) for name in ("licence", "trained_on") if getattr(loaded, name) == UNKNOWN}
    given["title"] = adapter.title
    loaded = replace(loaded, **{name: value for name, value in given.items() if value})
    return ExternalModel(text, ExternalEncoder(adapter, loaded))
