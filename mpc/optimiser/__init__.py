"""The optimisation of one sample: real-time iteration and the quadratic program."""
