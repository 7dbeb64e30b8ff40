"""Rigs without hardware: the twin and virtual devices."""
