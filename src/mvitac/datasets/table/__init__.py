"""Datasets that are a table of images and labels: columns, splits, images inside other files."""
