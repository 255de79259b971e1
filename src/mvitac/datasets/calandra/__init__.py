"""Grasps of Calandra et al. (2017), read as published."""

from mvitac.datasets.calandra import reader as reader
