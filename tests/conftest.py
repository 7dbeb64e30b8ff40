"""Before any test: one thread for linear algebra, whose matrices are small; the same examples in each run.

And Ctrl-C: a shell that starts the tests in the background has them ignore it, and so would the programs that
they start.
"""

from __future__ import annotations

import os
import signal

from hypothesis import settings

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

settings.register_profile("steady", derandomize=True, deadline=None)
settings.load_profile("steady")

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
