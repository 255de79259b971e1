"""The colours of every figure and page."""

COLOURS = {
    "card": "#ffffff",
    "ink": "#1d232b",
    "soft": "#5a6470",
    "rule": "#dde2e7",
    "panel": "#eef1f4",
    "blue": "#0072b2",
    "vermilion": "#d55e00",
    "green": "#009e73",
    "purple": "#b5629a",
    "amber": "#d18f00",
    "sky": "#4fb0e2",
    "olive": "#8d8a1e",
    "brown": "#7b5334",
    "grey1": "#6d7783",
    "grey2": "#8c95a0",
    "grey3": "#a8b0b9",
    "grey4": "#c2c8cf",
}
"""Hues after Okabe and Ito, distinct with any colour vision."""
HUES = ("blue", "vermilion", "green", "amber", "purple", "sky", "olive", "brown")
MODALITY_HUES = {"touch": "blue", "vision": "vermilion", "both": "green"}
CONTROL_GREYS = {"imagenet": "grey1", "start": "soft", "untrained": "grey2", "pixels": "grey3", "border": "grey4"}
