"""Everything from logs to a report in one command: the demo and the paper's experiments."""
