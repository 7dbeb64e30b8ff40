"""Numbers on a line: whole, in one spelling, so that the same value is the same bytes on both sides."""

from __future__ import annotations

import re
from collections.abc import Sequence

__all__ = ["integer", "integers", "join"]

_INT = re.compile(r"0|-?[1-9][0-9]{0,9}")


def integer(text: str) -> int | None:
    """Return a 32-bit integer, signed or not, in its one spelling; None for anything else.

    Examples
    --------
    >>> integer("-25"), integer("025"), integer("4294967296")
    (-25, None, None)
    """
    value = int(text) if _INT.fullmatch(text) else None
    return value if value is not None and -(2**31) <= value <= 0xFFFFFFFF else None


def integers(text: str) -> tuple[int, ...] | None:
    """Return integers with commas between them, None if one is none."""
    values = [integer(word) for word in text.split(",")]
    whole = tuple(value for value in values if value is not None)
    return whole if len(whole) == len(values) else None


def join(values: Sequence[int | str]) -> str:
    """Return the values with commas between them."""
    return ",".join(str(value) for value in values)
