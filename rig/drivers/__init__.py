"""Rigs on a port: ``connect.open_rig``, and the drivers of our firmware and of the TCLab behind it."""
