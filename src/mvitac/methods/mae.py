"""Masked autoencoder (He et al., CVPR 2022, arXiv:2111.06377), for each modality.

A ViT sees a random quarter of the patches. A narrow decoder gets its output tokens, and a mask token with its position for
each hidden patch, and predicts the hidden pixels:

    L = mean over hidden patches i and their P pixels of (d_i - x_i)^2,    x_i <- (x_i - mean(x_i)) / sqrt(var(x_i) + 1e-6)

The variance is the unbiased one (P - 1), as in the authors' code; Sparsh predicts plain pixels (``pixel_norm`` off).
The frames of a window are channels: a patch spans all of them, so that masks are tubes (VideoMAE, Tong et al.,
arXiv:2203.12602, with one tubelet).
Sources: the paper (section 3, appendix A); facts of https://github.com/facebookresearch/mae (models_mae.py).
Not implemented: the authors' optimiser (the recipe's, for all methods), and fixed positions (here the trunk's own).

Shapes: B images, N patches of P values (pixels x channels), K of them visible, D features.
"""

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from mvitac.data.spec import DataSpec
from mvitac.methods.base import Contrastive, Embeddings, MethodConfig, Views, with_sum
from mvitac.nn import vit
from mvitac.nn.encoders import Encoders

EPS = 1e-6  # added to the variance of a patch, as in the authors' code


@dataclass(frozen=True, kw_only=True)
class MAEConfig(MethodConfig):
    """Predict the pixels of hidden patches from visible ones. Needs a ViT."""

    name: ClassVar[str] = "mae"
    needs_vit: ClassVar[bool] = True

    mask_ratio: float = 0.75
    """Share of the patches that is hidden (MAE, Sparsh: .75; T3: .4)."""
    pixel_norm: bool = True
    """Predict each patch minus its mean and over its standard deviation (MAE, T3). Sparsh and AnyTouch: off."""


def split_patches(noise: Float[Tensor, "B N"], mask_ratio: float) -> tuple[Int[Tensor, "B K"], Int[Tensor, "B N-K"]]:
    """The patches with the least noise, K = int(N (1 - mask_ratio)) of them, and the others; one at least of each."""
    num = noise.shape[1]
    visible, order = min(max(1, int(num * (1 - mask_ratio))), num - 1), noise.argsort(dim=1)
    return order[:, :visible], order[:, visible:]


class MAE(Contrastive, config=MAEConfig):
    """A ViT and a decoder per modality. Width and depth of a decoder are two thirds of the trunk's, at most 512 and 8."""

    def __init__(self, config: MAEConfig, spec: DataSpec, encoder: Encoders) -> None:
        super().__init__()
        self.config = config
        self.trunks = vit.build_vits(encoder, spec, config.name)
        self.decoders = nn.ModuleDict()
        for modality, trunk in self.trunks.items():
            pixels = vit.patches(trunk, torch.zeros(1, spec.channels(modality), 1, 1)).shape[2]
            self.decoders[modality] = vit.Predictor(trunk, pixels, 2 / 3, (512, 8))

    def queries(self, batch: Views) -> Embeddings:
        """("loss", modality) -> [B], the loss of each row."""
        result: Embeddings = {}
        for stream, (modality, trunk) in enumerate(self.trunks.items()):
            images = batch.images[modality][0]
            noise = vit.row_uniform(batch.seed, batch.rows, math.prod(vit.grid_of(trunk, images)), stream)
            visible, hidden = split_patches(noise, self.config.mask_ratio)
            predicted = self.decoders[modality](vit.encode_visible(trunk, images, visible), hidden[:, None])[:, 0]
            with torch.autocast(images.device.type, enabled=False):
                values = vit.take(vit.patches(trunk, images.float()), hidden)
                if self.config.pixel_norm:
                    variance, mean = torch.var_mean(values, dim=2, keepdim=True, correction=1)
                    values = (values - mean) / (variance + EPS).sqrt()
                result["loss", modality] = ((predicted.float() - values) ** 2).flatten(1).mean(1)
        return result

    def contrast(self, z: Embeddings) -> dict[str, Tensor]:
        return with_sum({m: z["loss", m].mean() for m in self.trunks})

    def encoders(self) -> dict[str, nn.Module]:
        return dict(self.trunks)
