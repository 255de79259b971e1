"""Touch and Go (Yang et al., 2022), read as published."""

from mvitac.datasets.touch_and_go import reader as reader
