"""One session: settle, stop the pump, grasp, record; and schedules played for identification.

Others use ``session.run_session`` and ``play``, ``signals.stop_signals`` and ``snapshot.Snapshot``.
"""
