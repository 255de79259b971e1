"""Simulated visual-tactile data: object reliefs, gel optics and the data sets made from them (numpy and scipy only)."""
