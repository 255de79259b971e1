"""Encoders of other people, one file per owner. Importing this package imports and registers all of them."""

from mvitac.nn.external.base import Adapter, Loaded, open_encoder
from mvitac.nn.external.encoder import ExternalEncoder, Layout
from mvitac.nn.external.preprocessing import Preprocessing
from mvitac.registry import import_all

__all__ = ["Adapter", "ExternalEncoder", "Layout", "Loaded", "Preprocessing", "open_encoder"]
import_all(__name__, __path__)
