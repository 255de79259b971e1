"""Contrastive Multiview Coding as Touch and Go's authors run it (TAG): across modalities, against memory banks, by NCE.

One trunk and one linear layer per modality, L2-normalised: z_v, z_t. Each modality keeps a bank with one embedding per
training row; a vision query is told its own row of the touch bank from K rows drawn at random, and the other way round:

    s_j   = exp(z_v . bank_t[j] / tau) / Z,      Z = N * mean of exp(...) over the first batch, fixed from then on
    L_vt  = -log( s_+ / (s_+ + K/N) ) - sum over the K drawn of log( (K/N) / (s_j + K/N) ),    mean over the batch

The K rows are drawn evenly, with replacement, the query's own row not excluded, one draw for both directions. After the
step, bank rows move: bank[i] <- normalised .5 bank[i] + .5 z_i. There is no momentum encoder and one view per image.
On many processes each holds its share of the banks' rows and scores every query against the drawn ones among them.
Sources: arXiv:1906.05849 (eq. 8 - 12); https://github.com/HobbitLong/CMC (NCE/);
https://github.com/fredfyyang/Touch-and-Go (train_CMC_touch.py: K 16384, tau .07, bank momentum .5, 128-d).

N rows of training data, B in a batch, K negatives, D = 128.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, cast

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor, nn

from mvitac.data.spec import DataSpec
from mvitac.methods.base import Contrastive, MethodConfig, Views
from mvitac.nn.encoders import EncoderConfig, build_towers
from mvitac.nn.memory_bank import Bank
from mvitac.system.distributed import World

EPS = 1e-7
"""Added to both denominators, as the owner's code does."""


@dataclass(frozen=True, kw_only=True)
class CMCConfig(MethodConfig):
    """Vision against a memory bank of touch and the other way round, by noise-contrastive estimation (TAG's baseline)."""

    name: ClassVar[str] = "cmc"

    num_negatives: int = 16384
    """K, rows drawn from the bank for each query (TAG: 16384)."""
    temperature: float = 0.07
    """tau (TAG: .07)."""
    bank_momentum: float = 0.5
    """Share of its old value that a bank row keeps at an update (TAG: .5)."""
    softmax: bool = False
    """InfoNCE over the positive and the K drawn rows instead of NCE (an option of the owner's code)."""
    out: int = 128
    """Width of the embeddings (TAG: 128)."""

    def __post_init__(self) -> None:
        self.check_fields(positive=("temperature",), share=("bank_momentum",), width=("out",))
        if not 1 <= self.num_negatives <= 1 << 20:
            raise ValueError(f"num_negatives {self.num_negatives}: give 1 to {1 << 20}")

    def build(self, spec: DataSpec, encoder: EncoderConfig) -> CMC:
        self.check_pairs(spec)
        return CMC(self, spec, encoder)


def nce(scores: Float[Tensor, "B _"], noise: float, held: Bool[Tensor, "B _"]) -> Float[Tensor, ""]:
    """NCE of normalised ``scores`` (column 0 is the positive's) against even ``noise`` (K / N): what those ``held`` by this
    process add to it."""
    positive, negatives = scores[:, 0], scores[:, 1:]
    told = torch.log(positive / (positive + noise + EPS))
    rejected = torch.log(noise / (negatives + noise + EPS))
    told, rejected = torch.where(held[:, 0], told, 0.0), torch.where(held[:, 1:], rejected, 0.0)
    return -(told + rejected.sum(1)).mean()


def condensed(logits: Float[Tensor, "B _"], held: Bool[Tensor, "B _"], world: World) -> Float[Tensor, "B _"]:
    """Logits with the same softmax at column 0, complete on every process: the positive's, then the log-sum-exp of the
    negatives ``held`` by each process. On one process all logits as they are."""
    if world.size == 1:
        return logits
    none = torch.finfo(logits.dtype).min  # and not -inf, whose gradient is no number where a process holds none
    part = logits.new_zeros(len(logits), 1 + world.size)
    part[:, 0] = torch.where(held[:, 0], logits[:, 0], 0.0)
    part[:, 1 + world.rank] = torch.where(held[:, 1:], logits[:, 1:], none).logsumexp(1)
    return world.sum(part)


class CMC(Contrastive):
    """Two towers, two banks."""

    rows: Tensor
    z_norm: Tensor

    def __init__(self, config: CMCConfig, spec: DataSpec, encoder: EncoderConfig) -> None:
        super().__init__()
        self.config = config
        self.towers = build_towers(encoder, spec, lambda width: nn.Linear(width, config.out))
        self.banks = nn.ModuleDict()
        self.register_buffer("rows", torch.zeros(0, dtype=torch.int64))
        self.register_buffer("z_norm", torch.zeros(2))  # Z of vision's and of touch's queries; 0 = not fixed yet
        self.pending: tuple[Tensor, dict[str, Tensor], Tensor] | None = None

    def prepare(self, rows: Tensor) -> None:
        self.rows = rows
        self.banks = nn.ModuleDict({m: Bank(len(rows), self.config.out) for m in self.towers})

    def queries(self, batch: Views) -> dict[str, Tensor]:
        return {m: F.normalize(tower(batch.images[m][0]).float(), dim=1) for m, tower in self.towers.items()}

    def keys(self, batch: Views) -> dict[str, Tensor]:
        return {"rows": batch.rows}

    def contrast(self, z: dict[str, Tensor]) -> dict[str, Tensor]:
        assert len(self.rows), "prepare(rows) comes first"
        at = torch.searchsorted(self.rows, z["rows"])
        drawn = torch.randint(len(self.rows), (len(at), self.config.num_negatives + 1), device=at.device)[:, 1:]
        vision, touch = cast(Bank, self.banks["vision"]), cast(Bank, self.banks["touch"])
        place = torch.cat([touch.find(at)[:, None], touch.find_drawn(drawn)], dim=1)  # in either bank
        with torch.autocast(at.device.type, enabled=False):
            vt, z_vision = self._contrast(z["vision"], touch, place, self.z_norm[0])
            tv, z_touch = self._contrast(z["touch"], vision, place, self.z_norm[1])
        self.pending = (at, {m: z[m].detach() for m in self.towers}, torch.stack([z_vision, z_touch]))
        return {"loss": vt + tv, "vt": vt, "tv": tv}

    def _contrast(self, query: Tensor, bank: Bank, place: Tensor, fixed: Tensor) -> tuple[Tensor, Tensor]:
        """The loss of ``query`` against the rows of ``bank`` at ``place``, the positive's first, and its Z."""
        dots, held = bank.dots(query, place)
        logits, world, num = dots / self.config.temperature, bank.world, self.config.num_negatives
        if self.config.softmax:
            return F.cross_entropy(condensed(logits, held, world), torch.zeros_like(place[:, 0])), fixed
        scores = logits.exp()
        mean = torch.where(held, scores.detach(), 0.0).mean() * (place.shape[1] / (num + 1))
        norm = torch.where(fixed > 0, fixed, world.sum(mean) * len(self.rows))
        return world.sum(nce(scores / norm, num / len(self.rows), held)), norm

    def after_step(self, progress: float) -> None:
        assert self.pending is not None, "forward comes first"
        at, z, norm = self.pending
        for modality, bank in self.banks.items():
            bank.follow(at, z[modality], self.config.bank_momentum)  # type: ignore[operator]
        self.z_norm.copy_(norm)

    def encoders(self) -> dict[str, nn.Module]:
        return {m: tower.trunk for m, tower in self.towers.items()}  # type: ignore[misc]

    def projectors(self) -> dict[str, nn.Module]:
        return {m: tower.head for m, tower in self.towers.items()}  # type: ignore[misc]
