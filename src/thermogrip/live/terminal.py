"""A session on a terminal: its numbers, and what happened last; the same in one line where there is none."""

from __future__ import annotations

from collections.abc import Mapping
from math import isfinite
from typing import TYPE_CHECKING, Any

from thermogrip.media.rendering import printable
from thermogrip.rig.session.snapshot import Snapshot

if TYPE_CHECKING:
    from rich.console import RenderableType


def numbers(now: Snapshot) -> list[tuple[str, str]]:
    """Return what a session shows of itself, name and value."""
    others = {name: value for name, value in now.values.items() if name != now.skin}
    skin = now.values.get(now.skin, float("nan"))
    band = f" +- {now.band:g}" if isfinite(now.band) else ""
    rows = [(now.skin, _reading(skin))]
    rows += [(f"target of {name}", f"{value:g}{band} degC") for name, value in now.target.items()]
    rows += [(name, _reading(value)) for name, value in others.items()]
    units = {"1": "", "percent": " %", "0_255": " of 255"}
    rows += [(name, f"{value:+.3g}{units.get(now.units[name], '')}") for name, value in now.drive.items()]
    rows += [("pump", "on" if now.pump else "off")] if now.pump is not None else []
    remaining = f", {max(now.left_s, 0.0):.0f} s left" if isfinite(now.left_s) and not now.verdict else ""
    rows.append(("phase", (now.verdict or now.phase.replace("_", " ")) + remaining))
    if isfinite(now.margin):
        rows.append(("guard margin", f"{now.margin:.1f} K to the limit of {now.nearest}"))
    if isfinite(now.model_share):
        rows.append(("beside the model", f"{100 * now.model_share:.0f} % of what is allowed"))
    return rows


def _reading(value: float) -> str:
    return f"{value:.2f} degC" if isfinite(value) else "lost"


def line(now: Snapshot) -> str:
    """Return the numbers in one line."""
    shown = ", ".join(f"{name} {value}" for name, value in numbers(now))
    last = f"{now.events[-1].kind}: {now.events[-1].text}" if now.events else ""
    return printable(f"{now.time_s:.1f} s: {shown}; {now.trip.line() if now.trip else last}")


def panel(title: str, now: Snapshot | None, *, note: str = "", width: int = 100) -> RenderableType:
    """Return what a terminal shows."""
    from rich.console import Group
    from rich.panel import Panel
    from rich.table import Table
    from rich.text import Text

    if now is None:
        return Panel(Text(printable(note or "waiting for the first reading")), title=printable(title))
    grid = Table.grid(padding=(0, 2))
    rows = [(printable(name), printable(value)) for name, value in numbers(now)]
    columns = 2 if width >= 84 else 1
    half = -(-len(rows) // columns)
    for k in range(half):
        cells: list[Any] = []
        for name, value in rows[k::half]:
            cells += [Text(name, style="dim"), Text(value, style="bold")]
        grid.add_row(*cells)
    lines: list[Any] = [grid]
    if note:
        lines.append(Text(printable(note)))
    if now.events and now.trip is None:
        event = now.events[-1]
        lines.append(Text(printable(f"{event.time_s:.1f} s  {event.kind}: {event.text}"), style="dim"))
    lines += _ending(now)
    return Panel(Group(*lines), title=printable(title), title_align="left", border_style=_style(now))


def _ending(now: Snapshot) -> list[Any]:
    """Return how it ended, with what to do after a trip."""
    from rich.text import Text

    if not now.verdict:
        return []
    words = [Text(now.verdict, style=f"bold {_style(now)}")]
    if now.trip is not None:
        trip = now.trip
        about = {
            f"{trip.kind}, {trip.subject}": f"expected {trip.expected}, measured {trip.measured}",
            "check": trip.check,
            "to clear": trip.clear,
        }
        words += [Text(printable(f"{name}: {text}")) for name, text in about.items()]
    return words


def _style(now: Snapshot) -> str:
    styles: Mapping[str, str] = {"": "blue", "settled": "green", "played": "green", "tripped": "red"}
    return styles.get(now.verdict, "yellow")
