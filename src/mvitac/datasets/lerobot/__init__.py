"""Reads LeRobot datasets."""

from mvitac.datasets.lerobot import reader as reader
