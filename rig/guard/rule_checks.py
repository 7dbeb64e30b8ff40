r"""Does it warm when it is heated and cool when it is cooled?  The rules that need no model.

They are the rules of 3-D printers (Klipper's ``verify_heater``, Marlin's ``WATCH_TEMP``) with a sign, because
a Peltier drive does both, over a sliding window of ``window`` seconds in which the mean drive was at least
``drive`` of its range, either way:

*The wrong way.*  No output may move by more than ``wrong`` kelvin against the drive.

*Nowhere.*  The output that moves most must move by at least ``least`` kelvin with the drive, unless it is
already ``far`` kelvin from the room on that side, where a rig at its limit may well stand still.

*Away.*  Once an output was within ``near`` of its target, the area by which it is beyond ``leave`` kelvin
from it may not exceed ``area`` kelvin seconds (Klipper's 120).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass

from thermogrip.datasets.limits import keyed
from thermogrip.rig.guard.trip import Trip


@dataclass(frozen=True)
class RuleSettings:
    """Numbers of the rules; see the module."""

    window: float = keyed(60.0, "window_s", 5, 3600)
    drive: float = keyed(0.5, "drive", 0.01, 1)
    wrong: float = keyed(2.0, "wrong_K", 0.05, 50)
    least: float = keyed(1.0, "least_K", 0.05, 50)
    far: float = keyed(8.0, "far_K", 0.5, 100)
    near: float = keyed(1.0, "near_K", 0.05, 50)
    leave: float = keyed(5.0, "leave_K", 0.1, 50)
    area: float = keyed(120.0, "area_K_s", 1, 1e5)


class RuleMonitor:
    """Apply the rules; pure: times are passed in."""

    def __init__(self, settings: RuleSettings | None = None) -> None:
        self.settings = RuleSettings() if settings is None else settings
        self.start()

    def start(self) -> None:
        """Forget the past."""
        self._past: deque[tuple[float, float, dict[str, float]]] = deque()
        self._been_near: dict[str, tuple[float, float]] = {}  # target, area so far
        self._last = float("nan")

    def check(
        self,
        time: float,
        drive: float,
        accepted: Mapping[str, float],
        *,
        room: float,
        target: Mapping[str, float],
    ) -> Trip | None:
        """Return the trip, if any.

        ``drive`` is what was applied since the last call, -1...1 of its range, positive heats; temperatures
        and targets are in degC, no target where nothing is regulated.
        """
        self._past.append((time, drive, dict(accepted)))
        while self._past and time - self._past[0][0] > self.settings.window:
            self._past.popleft()
        return self._moved(time, room) or self._away(time, accepted, target)

    def _moved(self, time: float, room: float) -> Trip | None:
        s, (start, _, first) = self.settings, self._past[0]
        if time - start < 0.95 * s.window:
            return None
        mean = sum(drive for _, drive, _ in self._past) / len(self._past)
        sign = 1.0 if mean > 0 else -1.0
        if min(sign * drive for _, drive, _ in self._past) < s.drive:
            return None
        last = self._past[-1][2]
        moved = {name: sign * (last[name] - first[name]) for name in last if name in first}
        if not moved:
            return None
        most = max(moved, key=moved.__getitem__)
        warmer = "warmer" if sign > 0 else "colder"
        asked = f"{warmer} in {time - start:.0f} s of drive {mean:+.2f}"
        worst = min(moved, key=moved.__getitem__)
        if moved[worst] < -s.wrong:
            measured = f"{sign * moved[worst]:+.1f} K"
            return Trip("reversed", time, worst, asked, measured, figures={"moved": sign * moved[worst]})
        if moved[most] < s.least and sign * (last[most] - room) < s.far:
            measured = f"{sign * moved[most]:+.1f} K"
            expected = f"at least {s.least:g} K {asked}"
            return Trip("driver", time, most, expected, measured, figures={"moved": sign * moved[most]})
        return None

    def _away(self, time: float, accepted: Mapping[str, float], target: Mapping[str, float]) -> Trip | None:
        s = self.settings
        passed = time - self._last if self._last == self._last else 0.0
        self._last = time
        for name, goal in target.items():
            if name not in accepted:
                continue
            off = abs(accepted[name] - goal)
            known, area = self._been_near.get(name, (float("nan"), 0.0))
            if known != goal:
                if off <= s.near:
                    self._been_near[name] = (goal, 0.0)
                else:
                    self._been_near.pop(name, None)
                continue
            area = area + (off - s.leave) * passed if off > s.leave else 0.0
            self._been_near[name] = (goal, area)
            if area > s.area:
                expected = f"within {s.leave:g} K of the target {goal:g} degC, where it was"
                measured = f"{accepted[name]:.1f} degC"
                return Trip("model", time, name, expected, measured, figures={"area": area})
        return None
