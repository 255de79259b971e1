"""Touch and Go (Yang et al., 2022) as its owners ship it."""

from mvitac.datasets.touch_and_go import reader

__all__ = ["reader"]
