"""Encoders of other people."""

from mvitac.bench.external.model import ExternalModel, open_model

__all__ = ["ExternalModel", "open_model"]
