"""Rigs without hardware: the twin, virtual devices, simulated grasps."""
