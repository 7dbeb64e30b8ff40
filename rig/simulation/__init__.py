"""Rigs without hardware: ``twin.Twin`` and ``virtual_device.VirtualDevice``."""
