"""Reads and writes LeRobot datasets."""

from mvitac.datasets.lerobot import reader as reader
