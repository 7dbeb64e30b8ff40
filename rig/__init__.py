"""The rig: one interface for the twin and (later) hardware, and the session that records grasps."""
