"""Trained models in use: artifacts, exports, search, policies."""
