"""The one error that is the user's to correct.

Everything that a user can get wrong (a file, a column, an option) raises :class:`UserError`; the command line
prints its one line and exits with code 2.  Any other exception is our bug and exits with code 1.
"""

from __future__ import annotations

import errno
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from difflib import get_close_matches
from pathlib import Path
from typing import Any

_HINTS = {
    errno.ENOENT: ("no such file or folder", "check the path"),
    errno.EACCES: ("permission denied", "choose another folder or change its permissions"),
    errno.EPERM: ("permission denied", "choose another folder or change its permissions"),
    errno.EROFS: ("the disk is read-only", "choose another folder"),
    errno.ENOSPC: ("the disk is full", "free some space or choose another folder"),
    errno.EDQUOT: ("the disk quota is used up", "free some space or choose another folder"),
    errno.EISDIR: ("is a folder", "name a file"),
    errno.ENOTDIR: ("a part of the path is not a folder", "check the path"),
    errno.ENAMETOOLONG: ("the name is too long", "shorten it"),
    errno.EEXIST: ("exists already", "choose another name"),
}


class UserError(ValueError):
    """The user's input is at fault.

    What is wrong, the file, its row (as an editor counts lines) and column, and what to do: a clause each.

    Examples
    --------
    >>> error = UserError("'warm' is not a number", file="a.csv", row=7, column="t_degC", hint="write one")
    >>> print(error)
    a.csv, row 7, column t_degC: 'warm' is not a number; write one
    """

    def __init__(
        self,
        problem: str,
        *,
        file: str | Path | None = None,
        row: int | None = None,
        column: str | None = None,
        hint: str | None = None,
    ) -> None:
        self.problem, self.hint = problem, hint
        self.file = file
        self.row, self.column = row, column
        places = (("", file), ("row ", row), ("column ", column))
        where = ", ".join(filter(None, (f"{word}{place}" for word, place in places if place is not None)))
        text = f"{where}: {problem}" if where else problem
        super().__init__(" ".join(f"{text}; {hint}".split()) if hint else " ".join(text.split()))


@contextmanager
def as_user_error(
    kinds: type[Exception] | tuple[type[Exception], ...], problem: str, **where: Any
) -> Iterator[None]:
    """Raise an exception of these kinds as the :class:`UserError` of a problem (``{error}`` in it is what it
    says, ``{reason}`` with its kind) and a place; one that is a UserError already keeps its words, and gets
    the file where it names none."""
    try:
        yield
    except UserError as error:
        if error.file is not None or where.get("file") is None:
            raise
        place = {"file": where["file"], "row": error.row, "column": error.column}
        raise UserError(error.problem, **place, hint=error.hint) from error
    except kinds as error:
        text = str(error)[:200]
        # our own checks raise ValueError with a sentence; what else comes says little without its kind
        reason = text if type(error) is ValueError else f"{type(error).__name__}: {text}".removesuffix(": ")
        words = problem.replace("{error}", text).replace("{reason}", reason).removesuffix(" ()")
        raise UserError(words, **where) from error


def reading(problem: str, *, file: str | Path | None = None, hint: str) -> AbstractContextManager[None]:
    """Raise whatever stops the reader of a file as the :class:`UserError` of a problem and a reason.

    For parsers of other people's formats and for documents of ours: on damaged content they raise whatever
    they stumble over, so no list of exceptions is complete.  Nothing but reading belongs in the block.
    """
    return as_user_error(Exception, f"{problem} ({{reason}})", file=file, hint=hint)


def known_names(name: object, known: Iterable[str], words: str = "use {}") -> str:
    """Return a hint with the known names in place of the braces, and at its end the one most like ``name``
    (``it has drive, pump; did you mean 'drive'?``)."""
    by_lower = {known_name.lower(): known_name for known_name in known}
    nearest = get_close_matches(str(name).lower(), by_lower, 1, 0.65)
    meant = f"did you mean {by_lower[nearest[0]]!r}?" if nearest and by_lower[nearest[0]] != name else ""
    return "; ".join(filter(None, (words.format(", ".join(by_lower.values())), meant)))


def os_fault(error: OSError, path: str | Path) -> UserError:
    """Return the :class:`UserError` for what the operating system refused."""
    problem, hint = _HINTS.get(
        error.errno or 0, (error.strerror or str(error), "check the path and the disk")
    )
    return UserError(problem, file=path, hint=hint)


@contextmanager
def os_faults(path: str | Path) -> Iterator[None]:
    """Raise what the operating system refuses of a path as :class:`UserError`."""
    try:
        yield
    except OSError as error:
        raise os_fault(error, path) from error
