"""Closed loop: what touch is worth to a controller (``servo-v1``), and whether a policy uses it (``ablate``)."""
