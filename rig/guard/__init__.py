"""What ends a session that is not safe: limits, sensors, and a rig that does not follow its plant.

Others use ``guard.Guard``, ``guard.GuardSettings``, ``settings.read_guard`` and ``trip.Trip``.
"""
