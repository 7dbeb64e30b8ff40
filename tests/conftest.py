"""Before any test: one thread for linear algebra, whose matrices are small; the same examples in each run."""

from __future__ import annotations

import os

from hypothesis import settings

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

settings.register_profile("steady", derandomize=True, deadline=None)
settings.load_profile("steady")
