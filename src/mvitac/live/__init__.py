"""Cameras in, predictions out."""
