"""A session on a terminal: its numbers, a sparkline of the last minutes, and what happened last.

Where there is no terminal the same numbers are one line, at most once a second.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from math import isfinite
from typing import TYPE_CHECKING, Any

from thermogrip.datasets.media import printable
from thermogrip.rig.session.snapshot import Snapshot

if TYPE_CHECKING:
    from rich.console import RenderableType

MINUTES = 5
_BARS, _PLAIN_BARS = "▁▂▃▄▅▆▇█", "_.-=*#"
#: Of a session's state: how it looks on a terminal that has the signs, and on one that has not.
_ICONS = {"tripped": ("⚠", "!"), "settled": ("✓", "+"), "played": ("✓", "+"), "not settled": ("✗", "x")}


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
    left = f", {max(now.left_s, 0.0):.0f} s left" if isfinite(now.left_s) and not now.verdict else ""
    rows.append(("phase", (now.verdict or now.phase.replace("_", " ")) + left))
    if isfinite(now.margin):
        rows.append(("guard margin", f"{now.margin:.1f} K to the limit of {now.nearest}"))
    if isfinite(now.model_share):
        rows.append(("off the plant", f"{100 * now.model_share:.0f} % of what is allowed"))
    return rows


def _reading(value: float) -> str:
    return f"{value:.2f} degC" if isfinite(value) else "lost"


def line(now: Snapshot) -> str:
    """Return the numbers in one line."""
    shown = ", ".join(f"{name} {value}" for name, value in numbers(now))
    last = f"{now.events[-1].kind}: {now.events[-1].text}" if now.events else ""
    return printable(f"{now.time_s:.1f} s: {shown}; {now.trip.line() if now.trip else last}")


def sparkline(values: Sequence[float], width: int, bars: str = _BARS) -> str:
    """Return values as bars between the lowest and the highest, newest at the right; gaps are spaces; where
    there are more than the width, each bar is the mean of several."""
    size = max(1, -(-len(values) // width))
    kept = [_mean(values[at : at + size]) for at in range(0, len(values), size)]
    known = [value for value in kept if isfinite(value)]
    low, high = min(known, default=0.0), max(known, default=1.0)
    span = max(high - low, 1e-9)
    return "".join(
        bars[min(int((value - low) / span * len(bars)), len(bars) - 1)] if isfinite(value) else " "
        for value in kept
    )


def _mean(values: Sequence[float]) -> float:
    known = [value for value in values if isfinite(value)]
    return sum(known) / len(known) if known else float("nan")


class History:
    """The skin's last minutes, the mean of each even step of time."""

    def __init__(self, steps: int = 120) -> None:
        self.step = 60.0 * MINUTES / steps
        self._steps: deque[tuple[int, float, int]] = deque(maxlen=steps)  # number, sum, count

    def add(self, time_s: float, value: float) -> None:
        """Add one reading; a lost one is a gap, and time that goes back begins anew."""
        at = int(time_s // self.step)
        if self._steps and at < self._steps[-1][0]:
            self._steps.clear()
        while self._steps and at - self._steps[-1][0] > 1 and at - self._steps[-1][0] <= MINUTES * 60:
            self._steps.append((self._steps[-1][0] + 1, 0.0, 0))
        if not self._steps or self._steps[-1][0] != at:
            self._steps.append((at, 0.0, 0))
        if isfinite(value):
            _, total, count = self._steps.pop()
            self._steps.append((at, total + value, count + 1))

    @property
    def means(self) -> list[float]:
        """The means, oldest first; NaN where nothing was read."""
        return [total / count if count else float("nan") for _, total, count in self._steps]


def panel(
    title: str,
    now: Snapshot | None,
    history: History,
    *,
    note: str = "",
    width: int = 100,
    plain: bool = False,
) -> RenderableType:
    """Return what a terminal shows."""
    from rich.box import ASCII, ROUNDED
    from rich.console import Group
    from rich.panel import Panel
    from rich.table import Table
    from rich.text import Text

    box = ASCII if plain else ROUNDED
    if now is None:
        return Panel(
            Text(printable(note or "waiting for the first reading")), title=printable(title), box=box
        )
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
    means = history.means
    known = [value for value in means if isfinite(value)]
    if len(known) > 1:
        bars = sparkline(means, max(10, width - 36), _PLAIN_BARS if plain else _BARS)
        ends = f" {min(known):.1f} to {max(known):.1f} degC, last {MINUTES} min"
        lines.append(Text.assemble((bars, "cyan"), ends))
    if note:
        lines.append(Text(printable(note)))
    if now.events and now.trip is None:
        event = now.events[-1]
        lines.append(Text(printable(f"{event.time_s:.1f} s  {event.kind}: {event.text}"), style="dim"))
    lines += _end(now, plain)
    return Panel(Group(*lines), title=printable(title), title_align="left", box=box, border_style=_style(now))


def _end(now: Snapshot, plain: bool) -> list[Any]:
    """Return how it ended, with what to do after a trip."""
    from rich.text import Text

    if not now.verdict:
        return []
    icon = _ICONS.get(now.verdict, ("■", "*"))[plain]
    words = [Text(f"{icon} {now.verdict}", style=f"bold {_style(now)}")]
    if now.trip is not None:
        trip = now.trip
        about = {
            f"{trip.kind}, {trip.subject}": f"expected {trip.expected}, measured {trip.measured}",
            "check": trip.check, "to clear": trip.clear,
        }  # fmt: skip
        words += [Text(printable(f"{name}: {text}")) for name, text in about.items()]
    return words


def _style(now: Snapshot) -> str:
    styles: Mapping[str, str] = {"": "blue", "settled": "green", "played": "green", "tripped": "red"}
    return styles.get(now.verdict, "yellow")
