"""Run folders: written during a session, read and repaired after it, exported and streamed."""
