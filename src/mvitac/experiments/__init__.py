"""Comparisons of many runs, and the demo."""
