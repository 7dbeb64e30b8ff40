"""Input schedules for identification, and how much information they are expected to give."""
