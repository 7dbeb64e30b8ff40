"""Thermal touch with a finger that sets its own temperature.

The rooms are ``thermogrip.datasets``, ``sysid``, ``mpc``, ``rig`` and ``classify``; data flows through them
one way: logs -> plant -> controller -> session -> grasps -> classifier -> report.
"""

__version__ = "0.1.0"
