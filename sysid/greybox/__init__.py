"""Fits of models with physical parameters, how well these are identifiable, and posteriors."""
