"""Measurements that take longer than a test: run them as ``python -m benchmarks.NAME``."""
