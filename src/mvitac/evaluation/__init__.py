"""Evaluation of frozen features: probes, controls, confidence intervals."""
