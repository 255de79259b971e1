"""Contrastive Multiview Coding as used by the authors of Touch and Go (TAG): vision against touch, with memory banks.

One trunk and one linear layer per modality give L2-normalised embeddings z_v and z_t. Each modality has a bank with one
embedding per training row. The positive of a vision query is its own row of the touch bank; the negatives are K rows of
that bank, drawn at random. Touch queries use the vision bank in the same way. The loss is noise-contrastive estimation:

    s_j   = exp(z_v . bank_t[j] / tau) / Z,      Z = N * mean of exp(...) over the first batch, fixed from then on
    L_vt  = -log( s_+ / (s_+ + K/N) ) - sum over the K drawn of log( (K/N) / (s_j + K/N) ),    mean over the batch

The K rows are drawn uniformly with replacement and may include the query's own. Both directions share one draw. After
the step, bank rows are updated: bank[i] <- normalised .5 bank[i] + .5 z_i. An image has one view; no momentum encoder.
Sources: arXiv:1906.05849 (eq. 8 - 12); https://github.com/HobbitLong/CMC (NCE/);
https://github.com/fredfyyang/Touch-and-Go (train_CMC_touch.py: K 16384, tau .07, bank momentum .5, 128-d).

Shapes: N rows of training data, B in a batch, K negatives, D = 128.
"""

from dataclasses import dataclass
from typing import ClassVar, cast

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn
from tyro.conf import Fixed

from mvitac.data.spec import DataSpec
from mvitac.methods.base import Contrastive, Embeddings, MethodConfig, Views
from mvitac.nn.encoders import Encoders, build_towers
from mvitac.nn.memory_bank import Bank

EPS = 1e-7  # added to both denominators, as in the reference code
NEGATIVES_PER_ROW = 0.18  # at most: TAG's 16,384 of 91,982 rows


@dataclass(frozen=True, kw_only=True)
class CMCConfig(MethodConfig):
    """Noise-contrastive estimation of each modality against a memory bank of the other (TAG's baseline)."""

    name: ClassVar[str] = "cmc"
    needs_pairs: ClassVar[bool] = True

    num_negatives: int = 16384
    """Number of negatives K, drawn from the bank for each query (TAG: 16384); at most .18 per training row."""
    temperature: float = 0.07
    """Temperature tau (TAG: .07)."""
    bank_momentum: float = 0.5
    """Share of the old value that a bank row keeps in an update (TAG: .5)."""
    softmax: bool = False
    """Use InfoNCE over the positive and the K negatives instead of NCE (an option of the reference code)."""
    out: Fixed[int] = 128
    """Width of the embeddings (TAG: 128)."""

    def negatives(self, num_rows: int) -> int:
        return min(self.num_negatives, max(1, int(NEGATIVES_PER_ROW * num_rows)))


def nce(scores: Float[Tensor, "B _"], noise: float) -> Float[Tensor, ""]:
    """NCE loss of normalised scores s, whose column 0 is the positive's. ``noise`` is K / N: K times the uniform density."""
    positive, negatives = scores[:, 0], scores[:, 1:]
    accepted = torch.log(positive / (positive + noise + EPS))
    return -(accepted + torch.log(noise / (negatives + noise + EPS)).sum(1)).mean()


class CMC(Contrastive, config=CMCConfig):
    """A tower and a bank per modality."""

    rows: Tensor
    z_norm: Tensor

    def __init__(self, config: CMCConfig, spec: DataSpec, encoder: Encoders) -> None:
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

    def queries(self, batch: Views) -> Embeddings:
        return {m: F.normalize(tower(batch.images[m][0]).float(), dim=1) for m, tower in self.towers.items()}

    def keys(self, batch: Views) -> Embeddings:
        return {"rows": batch.rows}

    def contrast(self, z: Embeddings) -> dict[str, Tensor]:
        assert len(self.rows), "call prepare(rows) first"
        at = torch.searchsorted(self.rows, z["rows"])
        drawn = torch.randint(len(self.rows), (len(at), self.config.negatives(len(self.rows)) + 1), device=at.device)
        drawn[:, 0] = at  # the positive
        vision, touch = cast(Bank, self.banks["vision"]), cast(Bank, self.banks["touch"])
        with torch.autocast(at.device.type, enabled=False):
            vt, z_vision = self._contrast(z["vision"], touch, drawn, self.z_norm[0])
            tv, z_touch = self._contrast(z["touch"], vision, drawn, self.z_norm[1])
        self.pending = (at, {m: z[m].detach() for m in self.towers}, torch.stack([z_vision, z_touch]))
        return {"loss": vt + tv, "vt": vt, "tv": tv}

    def _contrast(self, query: Tensor, bank: Bank, at: Tensor, fixed: Tensor) -> tuple[Tensor, Tensor]:
        """The loss of one direction, and its normalisation constant Z, for embeddings ``query`` [B, D]. ``at`` [B, K +
        1] are rows of ``bank``, the other modality's; column 0 is the positive. ``fixed``: Z of earlier ones."""
        logits = bank.dots(query, at) / self.config.temperature
        if self.config.softmax:
            return F.cross_entropy(logits, torch.zeros_like(at[:, 0])), fixed
        scores = logits.exp()
        norm = torch.where(fixed > 0, fixed, scores.detach().mean() * len(self.rows))
        return nce(scores / norm, (at.shape[1] - 1) / len(self.rows)), norm

    def after_step(self, progress: float) -> None:
        assert self.pending is not None, "call forward first"
        at, z, norm = self.pending
        for modality, bank in self.banks.items():
            bank.follow(at, z[modality], self.config.bank_momentum)  # type: ignore[operator]
        self.z_norm.copy_(norm)

    def projectors(self) -> dict[str, nn.Module]:
        return {m: tower.head for m, tower in self.towers.items()}  # type: ignore[misc]
