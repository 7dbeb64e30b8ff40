"""Splits, scores with intervals, curves and the harness that compares classifiers."""
