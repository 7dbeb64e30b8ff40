"""Run folders: written during a session, read and repaired after it, exported and streamed.

Others use ``run_folder.RunFolder``, ``read_run``, ``recover`` and ``export_run``, ``batch.run_batch`` and
``rosbridge.Bridge``.
"""
