"""The one error that is the user's to correct.

Everything that a user can get wrong (a file, a column, an option) raises :class:`UserError`; the command line
prints its one line and exits with code 2.  Any other exception is our bug and exits with code 1.
"""

from __future__ import annotations

from pathlib import Path


class UserError(ValueError):
    """The user's input is at fault.

    Parameters
    ----------
    problem : str
        What is wrong, in one clause.
    file : str or Path, optional
        The file at fault.
    row : int, optional
        Row of the file, counted as an editor counts lines (the header is 1).
    column : str, optional
        Column name as in the file.
    hint : str, optional
        What to do about it, in one clause.

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
        self.problem, self.file, self.row, self.column, self.hint = problem, file, row, column, hint
        places = (("", file), ("row ", row), ("column ", column))
        where = ", ".join(filter(None, (f"{word}{place}" for word, place in places if place is not None)))
        text = f"{where}: {problem}" if where else problem
        super().__init__(" ".join(f"{text}; {hint}".split()) if hint else " ".join(text.split()))
