"""Fits of linear, polynomial and neural models, with structure and order chosen on held-out stretches."""

from thermogrip import lazy_exports

__all__, __getattr__, __dir__ = lazy_exports(__name__)
