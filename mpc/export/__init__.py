"""A controller as C99, checked against Python."""
