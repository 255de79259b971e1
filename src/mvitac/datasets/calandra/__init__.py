"""Calandra et al.'s grasps (2017) as their owners ship them."""

from mvitac.datasets.calandra import reader

__all__ = ["reader"]
