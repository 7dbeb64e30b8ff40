"""One session: settle, stop the pump, grasp, record; and schedules played for identification.

Others use ``session.run_session`` and ``play``, and ``signals.stop_signals``.
"""
