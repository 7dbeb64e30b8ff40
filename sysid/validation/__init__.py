"""Free runs on logs that were not fitted: errors, bands, and tests of the residuals."""

from thermogrip import lazy_exports

__all__, __getattr__, __dir__ = lazy_exports(__name__)
