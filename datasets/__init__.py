"""The records every stage exchanges (Log, Grasps), their files and examples."""

from thermogrip import lazy_exports

__all__, __getattr__, __dir__ = lazy_exports(__name__)
