"""Terms added to and pruned from a network, decided on held-out logs."""

from thermogrip import lazy_exports

_HOME = {"Growth": "stepwise", "grow": "stepwise"}
__all__ = [*_HOME]
__getattr__, __dir__ = lazy_exports(__name__, _HOME)
