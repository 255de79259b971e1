"""Flips of touch images with the colours that the sensor would show for the mirrored touch.

An optical gel shows slope as colour: I(x, y) = I0 + rx gx + ry gy. I0 [3] is the image without contact, gx and gy are the
slopes of the imprint, and rx, ry [3] are the colour changes per unit of slope along x and y. Mirroring the pixels does not
change the sign of gx, which a mirrored touch would, and it mirrors the lamps. The correct mirrored image is

    I'(x) = I0(x) + M (I(-x) - I0(-x)),  M [3, 3] maps rx to -rx, ry to ry, and other colours (ink, shadow) to themselves

rx and ry need no calibration. Slopes are derivatives of one height, so d gx / dy = d gy / dx, and of all pairs of linear
colour mixtures only those of gx and gy satisfy this (integrability, as in uncalibrated photometric stereo: Yuille and
Snow, CVPR 1997). I0 is the sensor's mean image, shifted to the mean colour of the given image. The slopes of an imprint
sum to zero, so the mean colour comes from lamps and tint, which differ between sensors of one type and drift. The mean
image contains the average contact. This does no harm if the average contact is symmetric.
"""

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, UInt8
from scipy.linalg import eigh
from torch import Tensor

from mvitac.data.pack import Pack
from mvitac.transforms.random_views import ViewAugment

MIN_ROWS, NUM_ROWS = 32, 256
"""Minimum number of training rows of a sensor, and the number of rows that are used, evenly spaced."""
SIDE = 64  # approximate side in pixels at which colours are learned. Finer detail is noise and JPEG artefacts.
REST = 16  # side in pixels of I0. It resolves lamps and tint, but not the dots, which move with the contact.
MAX_CURL, MAX_STRETCH = 0.2, 30.0
"""Above these limits the result is not a pair of slopes. Curl is .03 to .11 for gels, simulated and real, and .25 to .5
for gray images."""


def slope_colours(images: Float[np.ndarray, "N H W 3"]) -> tuple[np.ndarray, np.ndarray, float]:
    """Learn the colours of slope from images of one sensor, minus their mean; ValueError if no mixtures are slopes.

    Returns ``colours`` [3, 2], rx and ry as columns, up to a common factor; ``mixtures`` [3, 2], where ``d @ mixtures``
    are gx and gy of a colour ``d``, up to the inverse factor; and ``curl``, 0 for perfect slopes and .5 for noise.
    """
    down = ((images[:, 2:, 1:-1] - images[:, :-2, 1:-1]) / 2).reshape(-1, 3)
    right = ((images[:, 1:-1, 2:] - images[:, 1:-1, :-2]) / 2).reshape(-1, 3)
    rounding = np.eye(3) * len(down) / 24  # variance of rounding to whole levels: regularises equal channels
    yy, xx, yx = down.T @ down + rounding, right.T @ right + rounding, down.T @ right
    # Find mixtures p, q [3] that minimise |d(p . I)/dy - d(q . I)/dx|^2 relative to their total variation.
    change = yy + xx
    shares, pairs = eigh(np.block([[yy, -yx], [-yx.T, xx]]), np.kron(np.eye(2), change))
    mixtures, curl = pairs[:, 0].reshape(2, 3).T, float(shares[0])
    slopes = mixtures.T @ change @ mixtures
    if curl > MAX_CURL or np.linalg.cond(slopes) > MAX_STRETCH:
        raise ValueError(f"colours do not follow slopes along x and y (curl {curl:.2f})")
    return change @ mixtures @ np.linalg.inv(slopes), mixtures, curl


class GelMirror:
    """Flips touch images of a pack on ``device``. Colours are learned once, from each sensor's training rows.

    Each gel of a stacked image is mirrored separately. ValueError if a sensor has too few rows, or its colours do not
    follow slopes.
    """

    def __init__(self, pack: Pack, device: torch.device) -> None:
        if not pack.spec.touch_channels:
            raise ValueError(f"dataset {pack.spec.name!r} has no touch to flip: give --augment.gel-flip plain")
        rows = pack.rows("train", "unlabelled", having=("touch",))
        self.sensors = pack.sensors
        """[pack.num]: number of each row's sensor."""
        self.gels: dict[int, list[tuple[Tensor, Tensor]]] = {}
        """Per sensor and gel: M' [3, 3] and I0(x) - M I0(-x) [size, size, 3], where I0 has zero mean colour."""
        for sensor in np.unique(self.sensors[rows]).tolist():
            own, name = rows[self.sensors[rows] == sensor], pack.sensor_names[sensor]
            if len(own) < MIN_ROWS:
                raise ValueError(
                    f"sensor {name!r} has {len(own)} training rows with touch, learning its colours needs {MIN_ROWS}:"
                    " give --augment.gel-flip plain"
                )
            own = own[np.linspace(0, len(own) - 1, min(len(own), NUM_ROWS)).astype(int)]
            try:
                gels = _shrunk(pack, own).split(3, dim=1)
                self.gels[sensor] = [tuple(t.to(device) for t in _learn(gel, pack.size)) for gel in gels]  # type: ignore
            except ValueError as error:
                raise ValueError(f"sensor {name!r}: {error}: give --augment.gel-flip plain") from None

    def random(
        self, images: UInt8[Tensor, "B C H W"], rows: np.ndarray, config: ViewAugment, generator: torch.Generator
    ) -> UInt8[Tensor, "B C H W"]:
        """Mirror ``images`` of the pack's ``rows``, each with probability ``config.flip``."""
        num, gels = len(images), images.shape[1] // 3
        which = torch.rand(num, gels if config.independent_sensors else 1, generator=generator) < config.flip
        return self(images, rows, which.expand(num, gels))

    @torch.no_grad()
    def __call__(
        self, images: UInt8[Tensor, "B C H W"], rows: np.ndarray, which: Bool[Tensor, "B G"]
    ) -> UInt8[Tensor, "B C H W"]:
        """Mirror the gels ``which`` (a mask on the CPU) of ``images`` of the pack's ``rows``. Returns channels-last."""
        out = images.permute(0, 2, 3, 1).clone(memory_format=torch.contiguous_format)
        for sensor in np.unique(self.sensors[rows]):
            here = torch.from_numpy(self.sensors[rows] == sensor)
            for gel, (matrix, rest) in enumerate(self.gels[sensor]):
                index = (here & which[:, gel]).nonzero().flatten().to(images.device, non_blocking=True)
                pixels = out[..., 3 * gel : 3 * gel + 3]
                with torch.autocast(images.device.type, enabled=False):
                    flipped = pixels[index].flip(2).float()
                    tint = flipped.mean((1, 2), keepdim=True)
                    mirrored = tint + (flipped - tint) @ matrix + rest
                pixels[index] = mirrored.round_().clamp_(0, 255).to(torch.uint8)
        return out.permute(0, 3, 1, 2)


def _shrunk(pack: Pack, rows: np.ndarray) -> Float[Tensor, "N C h w"]:
    """Touch images of ``rows``, reduced to about ``SIDE`` pixels by averaging."""
    parts = []
    for some in np.array_split(rows, -(-len(rows) // 32)):  # never hold all of them in full size
        whole = torch.from_numpy(np.ascontiguousarray(pack.images["touch"][some])).permute(0, 3, 1, 2)
        parts.append(F.avg_pool2d(whole.float(), max(1, pack.size // SIDE)))
    return torch.cat(parts)


def _learn(gel: Float[Tensor, "N 3 h w"], size: int) -> tuple[Tensor, Tensor]:
    """M' and I0(x) - M I0(-x) of one gel from images of it, where I0 has zero mean colour."""
    mean = gel.mean(0, keepdim=True)
    colours, mixtures, _ = slope_colours((gel - mean).permute(0, 2, 3, 1).double().numpy())
    # M maps rx to -rx, and ry and all other colours to themselves.
    matrix = torch.from_numpy((np.eye(3) - 2 * np.outer(colours[:, 0], mixtures[:, 0])).T).float()
    rest = F.interpolate(F.adaptive_avg_pool2d(mean, REST), (size, size), mode="bilinear")[0].permute(1, 2, 0)
    rest = rest - rest.mean((0, 1))
    return matrix, (rest - rest.flip(1) @ matrix).contiguous()
