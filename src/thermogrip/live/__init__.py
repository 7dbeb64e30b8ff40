"""A session while it runs: on the terminal, on a page, and in Foxglove.

Others use ``watch.Watch``.
"""
