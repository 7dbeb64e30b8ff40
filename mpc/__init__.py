"""Control: prediction model, observer, condensed QP, controller, PI baseline, tuning, review."""

from thermogrip import lazy_exports

__all__, __getattr__, __dir__ = lazy_exports(__name__)
