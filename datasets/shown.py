"""How a result shows itself in Python: a few lines at the prompt, the same as a table in a notebook."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape

from thermogrip.datasets.media import printable


class Shown:
    """Base of results that show a few facts of themselves."""

    def _facts(self) -> Mapping[str, object]:
        """Return what is shown, by name."""
        raise NotImplementedError

    def __repr__(self) -> str:
        lines = [printable(f"  {name:16}  {what}") for name, what in self._facts().items()][:18]
        cut = [line if len(line) <= 110 else f"{line[:107]}..." for line in lines]
        return "\n".join([type(self).__name__, *cut])

    def _repr_html_(self) -> str:
        rows = ((escape(printable(f"{part}")) for part in fact) for fact in self._facts().items())
        body = "".join(f"<tr><th>{name}</th><td>{what}</td></tr>" for name, what in rows)
        return f'<table style="text-align: left"><caption>{type(self).__name__}</caption>{body}</table>'
