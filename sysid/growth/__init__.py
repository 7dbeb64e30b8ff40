"""Terms added to and pruned from a network, decided on held-out logs."""

from thermogrip import lazy_exports

__all__, __getattr__, __dir__ = lazy_exports(__name__)
