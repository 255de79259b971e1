"""The colours of every figure and page."""

import numpy as np

COLOURS: dict[str, tuple[str, str]] = {
    "card": ("#ffffff", "#171c23"),
    "ink": ("#1d232b", "#e7eaee"),
    "soft": ("#5a6470", "#a0aab6"),
    "rule": ("#dde2e7", "#2d3540"),
    "panel": ("#eef1f4", "#20272f"),
    "blue": ("#0072b2", "#56aee8"),
    "vermilion": ("#d55e00", "#ff8a4c"),
    "green": ("#009e73", "#33c99d"),
    "purple": ("#b5629a", "#e2a0cb"),
    "amber": ("#d18f00", "#f0b840"),
    "sky": ("#4fb0e2", "#a5dbf9"),
    "olive": ("#8d8a1e", "#d9d45a"),
    "brown": ("#7b5334", "#bd936d"),
    "indigo": ("#5b21d6", "#7c5cff"),
    "grey1": ("#6d7783", "#99a3af"),
    "grey2": ("#8c95a0", "#7c8692"),
    "grey3": ("#a8b0b9", "#626c78"),
    "grey4": ("#c2c8cf", "#4c5661"),
}
"""Name -> colour on a light page and on a dark page. Hues after Okabe and Ito, distinct with any colour vision."""
HUES = ("blue", "vermilion", "green", "amber", "purple", "sky", "olive", "brown")
MAP_HUES = (*HUES, "ink", "indigo")  # ten colours for the explorer's map: as many as an eye can tell apart
MODALITY_HUES = {"touch": "blue", "vision": "vermilion", "both": "green"}
CONTROL_GREYS = {"imagenet": "grey1", "untrained": "grey2", "pixels": "grey3", "border": "grey4"}


def ramp(num: int) -> list[tuple[str, str]]:
    """``num`` colours from low to high (viridis), each for a light and a dark page, without the ends that vanish there."""
    from matplotlib import colormaps, colors  # imported here: it is slow, and few pages need it

    light, dark = (colormaps["viridis"](np.linspace(*ends, num)) for ends in ((0.0, 0.92), (0.15, 1.0)))
    return [(colors.to_hex(a), colors.to_hex(b)) for a, b in zip(light, dark, strict=True)]


def colour(name: str) -> str:
    """The colour ``name`` as drawn (its light variant)."""
    return COLOURS[name][0]
