"""Encoders of other people. Importing this package imports and registers all of their adapters."""

from mvitac.bench.external.base import Adapter, Loaded
from mvitac.bench.external.encoder import ExternalEncoder
from mvitac.bench.external.model import ExternalModel, open_model
from mvitac.bench.external.preprocessing import Preprocessing
from mvitac.registry import import_all

__all__ = ["Adapter", "ExternalEncoder", "ExternalModel", "Loaded", "Preprocessing", "open_model"]
import_all(__name__, __path__)
