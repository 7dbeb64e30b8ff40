"""Fits of models with physical parameters, how well these are identifiable, and posteriors."""

from thermogrip import lazy_exports

_HOME = {"Posterior": "posterior", "fit_network": "fit", "sample_posterior": "posterior"}
__all__ = [*_HOME]
__getattr__, __dir__ = lazy_exports(__name__, _HOME)
