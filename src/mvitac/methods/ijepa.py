"""I-JEPA (Assran et al., CVPR 2023, arXiv:2301.08243), for each modality.

A ViT sees a context: one large block of patches minus some small target blocks. From its output tokens a narrow predictor
predicts, block by block, the tokens that a momentum (teacher) copy has for the target blocks when it sees the whole image:

    L = smooth_L1(predictor(context, positions of a target block), layer_norm(teacher(image) at that block))

averaged over blocks, patches and features. The layer norm has no weights, and smooth L1 turns at 1. The teacher follows with
a momentum that rises linearly from .996 to 1. The frames of a window are channels of one image.

Block sizes are drawn once per batch (per chunk, with ``--chunk``), places once per image, as in the authors' code. Different
here, because masks are made on the device without waiting for it:
- Contexts have a fixed length, the (1 - .15)^4 of the image that 4 blocks leave if they do not overlap much: longer ones are
  cut at random, missing patches of shorter ones are hidden from attention.
- Of 8 draws, the first with 10 patches of context, else that with the most. A block may touch every border.
Sources: the paper (section 3, appendix A.1); facts of https://github.com/facebookresearch/ijepa (multiblock.py, train.py,
in1k_vith14_ep300.yaml). Not implemented: the rising weight decay (here the recipe's, for all methods).

Shapes: B images, N patches, K of them context, M target blocks of at most S patches, D features.
"""

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Int
from timm.models.vision_transformer import VisionTransformer
from torch import Tensor, nn

from mvitac.data.spec import DataSpec
from mvitac.methods.base import Contrastive, Embeddings, MethodConfig, Views, with_sum
from mvitac.nn import vit
from mvitac.nn.encoders import Encoders
from mvitac.nn.momentum import Momentum

TRIES = 8
ASPECT, CONTEXT, MIN_CONTEXT = (0.75, 1.5), (0.85, 1.0), 10
"""I-JEPA's: height over width of a target block; area of the context block, before the targets are taken out, as a range of
shares of the image; patches of context that an image should keep."""


@dataclass(frozen=True, kw_only=True)
class IJEPAConfig(MethodConfig):
    """Predict a momentum tower's tokens of hidden blocks from visible patches. Needs a ViT."""

    name: ClassVar[str] = "ijepa"
    needs_vit: ClassVar[bool] = True

    num_targets: int = 4
    """Number of target blocks M (I-JEPA: 4)."""
    target_scale: tuple[float, float] = (0.15, 0.2)
    """Area of a target block, as a range of shares of the image (I-JEPA: .15 to .2)."""
    ema: float = 0.996
    """Momentum of the teacher at the start (I-JEPA: .996). It rises to 1 linearly."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 < self.target_scale[0] <= self.target_scale[1] <= 1:
            raise ValueError(f"target_scale {self.target_scale}: give two rising numbers above 0, at most 1")


@dataclass(frozen=True)
class Blocks:
    """Context and targets of each image, as patch numbers; unused places are filled with any patch."""

    context: Int[Tensor, "B K"]
    in_context: Bool[Tensor, "B K"]  # which places of ``context`` are used
    targets: Int[Tensor, "B M S"]
    in_target: Bool[Tensor, "B M S"]


def block_sides(area: Tensor, aspect: Tensor, grid: tuple[int, int]) -> Tensor:
    """Height and width [2] of a block with a share ``area`` of the grid; aspect is height over width."""
    patches = (area * grid[0] * grid[1]).floor()
    sides = torch.stack([(patches * aspect).sqrt(), (patches / aspect).sqrt()]).round()
    return sides.clamp(min=1).minimum(torch.tensor(grid, dtype=sides.dtype).to(sides.device))


def multi_block(config: IJEPAConfig, seed: Tensor, rows: Tensor, stream: int, grid: tuple[int, int]) -> Blocks:
    """Draw the blocks of images ``rows`` [B], as a function of (seed, stream) and, for their places, of each row."""
    (height, width), num_targets = grid, config.num_targets
    device, num = rows.device, height * width

    # Sizes, the same for all images: [M + 1, 2], targets before context.
    draws = vit.row_uniform(seed, torch.full_like(rows[:1], -1), 3, 2 * stream)[0]
    ranges = (config.target_scale, ASPECT, CONTEXT)
    scale, aspect, context_scale = (low + (high - low) * u for (low, high), u in zip(ranges, draws, strict=True))
    side = block_sides(scale, aspect, grid)
    sides = torch.stack([side] * num_targets + [block_sides(context_scale, torch.ones_like(aspect), grid)])

    # Places: corners [B, TRIES, M + 1, 2], and which patches are inside [B, TRIES, M + 1, N].
    u = vit.row_uniform(seed, rows, TRIES * (num_targets + 1) * 2, 2 * stream).view(-1, TRIES, num_targets + 1, 2)
    last = torch.tensor(grid).to(device) - sides
    corner = (u * (last + 1)).floor().minimum(last)
    patch = torch.arange(num, device=device)
    place = torch.stack([patch // width, patch % width], dim=1)
    inside = ((place >= corner[..., None, :]) & (place < (corner + sides)[..., None, :])).all(-1)

    # The first try with enough context, else that with the most.
    contexts = inside[:, :, -1] & ~inside[:, :, :-1].any(2)
    counts = contexts.sum(2)
    rank = torch.where(counts >= MIN_CONTEXT, num + TRIES - torch.arange(TRIES, device=device), counts)
    best = rank.argmax(1, keepdim=True)[:, :, None, None]
    context = contexts.take_along_dim(best[..., 0], 1)[:, 0]
    corner = corner[:, :, :-1].take_along_dim(best, 1)[:, 0].long()

    # Patch numbers, in arrays whose size depends on the config only.
    room = max(1, round(num * (1 - config.target_scale[0]) ** num_targets))
    order = (context + vit.row_uniform(seed, rows, num, 2 * stream + 1)).argsort(dim=1, descending=True)[:, :room]
    in_context = torch.arange(room, device=device) < context.sum(1, keepdim=True).clamp(min=1)
    area, (low, high) = math.floor(config.target_scale[1] * num), ASPECT
    most_high, most_wide = (min(grid[i], max(1, round(math.sqrt(area * (high, 1 / low)[i])))) for i in (0, 1))
    slot = torch.arange(most_high * most_wide, device=device)
    offset = torch.stack([slot // most_wide, slot % most_wide], dim=1)
    row, column = (corner[:, :, None] + offset).unbind(-1)
    targets = row.clamp(max=height - 1) * width + column.clamp(max=width - 1)
    return Blocks(order, in_context, targets, (offset < side).all(1).expand_as(targets))


class IJEPA(Contrastive, config=IJEPAConfig):
    """A ViT, its momentum copy (the teacher) and a predictor per modality: half as wide and deep, at most 384 and 12."""

    def __init__(self, config: IJEPAConfig, spec: DataSpec, encoder: Encoders) -> None:
        super().__init__()
        self.config = config
        self.trunks = vit.build_vits(encoder, spec, config.name)
        self.teachers = nn.ModuleDict({m: Momentum(vit.vit_of(trunk)) for m, trunk in self.trunks.items()})
        predictors = {m: vit.Predictor(t, vit.vit_of(t).embed_dim, 1 / 2, (384, 12)) for m, t in self.trunks.items()}
        self.predictors = nn.ModuleDict(predictors)

    def blocks(self, batch: Views, modality: str) -> Blocks:
        """The blocks of each image that the ViT of ``modality`` sees."""
        trunk, stream = self.trunks[modality], list(self.trunks).index(modality)
        return multi_block(self.config, batch.seed, batch.rows, stream, vit.grid_of(trunk, batch.images[modality][0]))

    def queries(self, batch: Views) -> Embeddings:
        """("predicted", modality) -> [B, M S, D]."""
        result: Embeddings = {}
        for modality, trunk in self.trunks.items():
            blocks = self.blocks(batch, modality)
            seen = vit.encode_visible(trunk, batch.images[modality][0], blocks.context, blocks.in_context)
            predicted = self.predictors[modality](seen, blocks.targets, blocks.in_target)
            result["predicted", modality] = predicted.flatten(1, 2)
        return result

    @torch.no_grad()
    def keys(self, batch: Views) -> Embeddings:
        """("target", modality) -> [B, M S, D], and ("weight", modality) -> [B, M S], which sums to 1 for each row."""
        result: Embeddings = {}
        for modality in self.trunks:
            blocks = self.blocks(batch, modality)
            teacher: VisionTransformer = self.teachers[modality].module  # type: ignore[assignment]
            tokens = teacher.forward_features(batch.images[modality][0])[:, teacher.num_prefix_tokens :]
            target = vit.take(F.layer_norm(tokens.float(), tokens.shape[-1:]), blocks.targets.flatten(1))
            used = blocks.in_target.flatten(1).float()
            result["target", modality] = target
            result["weight", modality] = used / used.sum(1, keepdim=True)
        return result

    def contrast(self, z: Embeddings) -> dict[str, Tensor]:
        losses = {}
        for m in self.trunks:
            error = F.smooth_l1_loss(z["predicted", m].float(), z["target", m], reduction="none").mean(2)
            losses[m] = (error * z["weight", m]).sum(1).mean()
        return with_sum(losses)

    def encoders(self) -> dict[str, nn.Module]:
        return dict(self.trunks)

    def after_step(self, progress: float) -> None:
        for teacher in self.teachers.values():
            teacher.follow(self.config.ema + (1 - self.config.ema) * progress)  # type: ignore[operator]
