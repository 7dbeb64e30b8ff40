"""Kinds of values that the rooms hand each other.

A model's arithmetic is written once and takes :data:`Values`: numbers, rows with one entry a member of a
batch, CasADi's symbols, or vectors that a compiler sees.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Values = Sequence[Any]
Run = tuple[Array, Array]  # outputs (B, N + 1, n_y) and last states (B, n_x) of a batch
