"""Fits of linear, polynomial and neural models, with structure and order chosen on held-out stretches."""
