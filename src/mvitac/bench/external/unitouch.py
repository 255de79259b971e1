"""UniTouch: the touch tower of an ImageBind model. CC-BY-NC-SA 4.0 (code of ImageBind): non-commercial.

Names, shapes and preprocessing were read from cfeng16/UniTouch @00d1bdc. The licence of the weights was not found: that of
the code they come with is named. No owner's weights were at hand; no owner's code is used. Its attention has one learned
key and value more than tokens (``bias_k``, ``bias_v``), and tokens are not normalised before the first block.
"""

from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar

from timm.layers.mlp import Mlp
from torch import Tensor, nn

from mvitac.bench.external.base import Adapter, Loaded
from mvitac.bench.external.preprocessing import CLIP, Preprocessing
from mvitac.bench.external.tower import HEAD, projection, read_tensors, shape, tower, under

NAMES = {"cls_token": "front", "rgbt_stem.proj.1": "embed", "pos_embedding_helper.pos_embed": "positions"}
LENGTH = 5.0  # length of the features


@dataclass(frozen=True, kw_only=True)
class UniTouch(Adapter):
    """UniTouch (cfeng16/UniTouch)."""

    name: ClassVar[str] = "unitouch"
    expects: ClassVar[str] = "last_new.ckpt of huggingface.co/chfeng/Touch-LLM"

    def load(self) -> Loaded:
        whole = read_tensors(self.path())
        tensors = under(whole, "modality_preprocessors.touch.", NAMES)
        tensors |= under(whole, "modality_trunks.touch.")
        tensors |= under(whole, "modality_heads.touch.", {"0": "head.0", "2": "head.1"})
        width = shape(self, tensors, "embed.weight", 5)[0]
        head = projection(tensors, 1e-6)
        network = tower(self, tensors, head=head, scale=LENGTH, block=partial(BiasedBlock, width))
        made = Preprocessing(
            mean=CLIP[0], std=CLIP[1], frames=tensors["embed.weight"].shape[2], still=True, layout="video"
        )
        return Loaded(
            network=network,
            preprocessing=replace(made, size=network.size, shorter=network.size[0], bicubic=True),
            title="UniTouch",
            files=(self.path(),),
            licence="CC-BY-NC-SA-4.0",
            source="https://github.com/cfeng16/UniTouch",
        )


class BiasedBlock(nn.Module):
    """A transformer block whose attention has a learned key and value beside those of the tokens."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm_1, self.norm_2 = nn.LayerNorm(width, eps=1e-6), nn.LayerNorm(width, eps=1e-6)
        self.attn = nn.MultiheadAttention(width, max(1, width // HEAD), add_bias_kv=True, batch_first=True)
        self.mlp = Mlp(width, 4 * width)

    def forward(self, x: Tensor) -> Tensor:
        z = self.norm_1(x)
        x = x + self.attn(z, z, z, need_weights=False)[0]
        return x + self.mlp(self.norm_2(x))
