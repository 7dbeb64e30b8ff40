"""One finding of a design review: a verdict, what was found in numbers, and what to do about it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

__all__ = ["Check", "worst"]

_RANK = {"pass": 0, "warn": 1, "fail": 2}


@dataclass(frozen=True)
class Check:
    """One finding of the review.

    Attributes
    ----------
    name : str
    verdict : str
        ``"pass"``, ``"warn"`` or ``"fail"``.
    finding : str
        With numbers.
    fix : str
        What to do; empty where it passes.
    """

    name: str
    verdict: str
    finding: str
    fix: str = ""


def worst(checks: Sequence[Check]) -> str:
    """Return the worst verdict of a review.

    Examples
    --------
    >>> worst([Check("a", "pass", ""), Check("b", "warn", "")])
    'warn'
    """
    rank: Callable[[str], int] = _RANK.__getitem__
    return max((check.verdict for check in checks), key=rank, default="pass")
