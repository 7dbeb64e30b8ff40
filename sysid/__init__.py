"""Identification: from logs to a plant, its validation and export, excitation, contact physics, effusivity.

>>> from thermogrip.sysid import read_log, identify, Plant
>>> identify.__name__, Plant.__name__
('identify', 'Plant')
"""

from thermogrip import lazy_exports

__all__, __getattr__, __dir__ = lazy_exports(__name__)
