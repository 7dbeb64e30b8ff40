"""numba, which obeys no setting of the working folder: code in its cache is run."""

from __future__ import annotations

import os

os.environ.setdefault("NUMBA_CACHE_DIR", "")  # else .numba_config.yaml of the working folder may name one

import numba as numba
