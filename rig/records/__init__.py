"""Run folders: written during a session, read and repaired after it, exported and streamed.

Others use ``recorder.RunFolder``, ``run_folder.read_run`` and ``recover``, ``batch.run_batch``,
``export.export_run`` and ``rosbridge.Bridge``.
"""
