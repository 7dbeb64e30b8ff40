"""Identification: thermal networks, grey-box and black-box fits, posteriors, contact physics."""
