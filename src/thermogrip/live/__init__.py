"""A session while it runs: on the terminal, on a page, in Foxglove, and for a command on a trip.

Others use ``watch.Watch``.
"""
