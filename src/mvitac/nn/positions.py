"""Positions of the patches of a ViT as sines and cosines (Chen et al., MoCo v3, arXiv:2104.02057; MAE uses them too)."""

import torch
from torch import Tensor


def sin_cos_positions(height: int, width: int, features: int, device: torch.device | None = None) -> Tensor:
    """Fixed embeddings [height x width, ``features``] of the places of a grid, row by row.

    The four quarters of the features are sin(row w_i), cos(row w_i), sin(column w_i), cos(column w_i), with
    w_i = 10000^(-4 i / features).
    """
    assert features % 4 == 0, features
    rates = 10000.0 ** (-torch.arange(0, features, 4, device=device, dtype=torch.float32) / features)
    row, column = (torch.arange(side, device=device, dtype=torch.float32)[:, None] * rates for side in (height, width))
    across_rows = torch.cat([row.sin(), row.cos()], 1)[:, None].expand(-1, width, -1)
    across_columns = torch.cat([column.sin(), column.cos()], 1)[None].expand(height, -1, -1)
    return torch.cat([across_rows, across_columns], 2).flatten(0, 1)
