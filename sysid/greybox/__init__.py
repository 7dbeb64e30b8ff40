"""Fits of models with physical parameters, how well these are identifiable, and posteriors."""

from thermogrip import lazy_exports

__all__, __getattr__, __dir__ = lazy_exports(__name__)
