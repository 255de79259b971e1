"""Packs: what a dataset is, how it is written to disk, read back and checked."""
