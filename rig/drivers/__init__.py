"""Rigs on a port: our firmware and the TCLab behind the rig's interface."""
