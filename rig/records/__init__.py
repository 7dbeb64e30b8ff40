"""Run folders: written during a session, read and repaired after it, exported and streamed.

Others use ``recorder.RunFolder``, ``run_folder.read_run``, ``recover`` and ``export_run``,
``batch.run_batch`` and ``rosbridge.Bridge``.
"""
