"""Any model of timm: DINOv2, CLIP, ImageNet trunks, or random weights. Licences are those that timm states.

Preprocessing is that of the model's ``pretrained_cfg`` (huggingface/pytorch-image-models @aa4b585).
"""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

from timm.data.config import resolve_data_config
from torch import nn

from mvitac.bench.external.base import NOTHING, RANDOM, UNKNOWN, Adapter, Loaded, seeded
from mvitac.bench.external.preprocessing import Preprocessing
from mvitac.nn import imagenet
from mvitac.nn.encoders import IMAGENET, SCRATCH, EncoderConfig, build_trunk
from mvitac.nn.weights import said_trained_on
from mvitac.system.files import brief

SETS = {
    "in1k": "ImageNet-1k",
    "in12k": "ImageNet-12k",
    "in21k": "ImageNet-21k",
    "in22k": "ImageNet-22k",
    "dino": "ImageNet-1k",
    "mae": "ImageNet-1k",
    "openai": "OpenAI's image-text pairs",
    "laion400m": "LAION-400M",
    "laion2b": "LAION-2B",
    "datacomp1b": "DataComp-1B",
    "webli": "WebLI",
    "lvd142m": "LVD-142M",
    "lvd1689m": "LVD-1689M",
}
"""Parts of timm's tags for weights -> what they were trained on."""


def said(tag: str) -> str:
    """What timm's tag of pretrained weights says of their data."""
    found = dict.fromkeys(SETS[part] for part in tag.split("_") if part in SETS)
    return f"{', '.join(found)} (timm's tag {tag})" if found else UNKNOWN


@dataclass(frozen=True, kw_only=True)
class Timm(Adapter):
    """A model of timm."""

    name: ClassVar[str] = "timm"
    weights: str = "pretrained"
    """pretrained (timm downloads them), random, or a file."""

    def load(self) -> Loaded:
        if self.place.endswith(".openai") and "quickgelu" not in self.place:
            quick = self.place.replace("_clip_", "_clip_quickgelu_")
            raise ValueError(f"{self.place}: OpenAI's weights need QuickGELU: {quick}")
        known = {"pretrained": IMAGENET, "random": SCRATCH}
        network = seeded(partial(self._built, known.get(self.weights, self.weights)), self.seed)
        cfg: dict[str, Any] = getattr(network, "pretrained_cfg", None) or {}
        usual = resolve_data_config(pretrained_cfg={"name": self.place, **cfg})
        random, named, file = self.weights == "random", self.weights in known, Path(self.weights)
        page = f"https://huggingface.co/{cfg.get('hf_hub_id')}"
        return Loaded(
            network,
            Preprocessing(size=usual["input_size"][1:], mean=usual["mean"], std=usual["std"]),
            f"{self.place}, {self.weights if named else file.name}",
            files=() if named else (file,),
            licence=RANDOM if random else (named and cfg.get("license")) or UNKNOWN,
            source=imagenet.source(self.place) or page if self.weights == "pretrained" else self.weights,
            trained_on=NOTHING if random else said(cfg.get("tag") or "") if named else said_trained_on(file) or UNKNOWN,
        )

    def _built(self, weights: str) -> nn.Module:
        trunk = build_trunk(EncoderConfig(trunk=self.place, weights=weights), 3)
        if self.size and hasattr(trunk, "set_input_size"):
            try:
                trunk.set_input_size(img_size=self.sides((224, 224)))  # type: ignore[operator]
            except Exception as error:  # each model has its own rules
                raise ValueError(f"{self.place} cannot take size {self.size} ({brief(error)})") from None
        return trunk
