"""Weights found by closed-loop trials on draws of the plant, and what they trade."""
