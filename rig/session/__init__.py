"""One session: settle, stop the pump, grasp, record; and schedules played for identification."""
