"""Write docs/reference/faults.md: every fault that is drilled, and what it costs.

    python benchmarks/rig/faults.py --out docs/reference/faults.md --record docs/records/faults.md \
        --nominal nominal*.json --day day.txt

``--nominal``: what benchmarks/rig/nominal.py wrote, of one seed or several, and with ``--off``; ``--day``: what
benchmarks/rig/day.py printed.  From them come the false alarms that the detection times stand beside.  Without ``--nominal`` the table
of drills alone is written anew into a page that is there.

The drills are those of tests/rig/fault_injection/test_drills.py (:mod:`tests.rig.fault_injection.drills`,
:mod:`tests.rig.fault_injection.host_drills`).
"""

from __future__ import annotations

import argparse
import json
import re
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from textwrap import fill
from typing import Any

from scipy.stats import chi2

from thermogrip.mpc.controllers.pi import PIController
from thermogrip.mpc.interface import Move, Readings, Target
from thermogrip.rig.guard.guard import Guard, GuardSettings
from thermogrip.rig.guard.model_checks import ModelSettings
from thermogrip.rig.guard.plant_mismatch import PlantDrift
from thermogrip.rig.guard.sensor_checks import SensorSettings, repeats_needed
from thermogrip.rig.guard.trip import ENDLESS, KINDS
from thermogrip.rig.interface import Reading
from thermogrip.rig.session.session import run_session
from thermogrip.rig.simulation.twin import Twin

sys.path.insert(0, str(Path(__file__).parents[2]))  # the drills are tests
from benchmarks.rig.limits import with_limits
from tests.rig.fault_injection.drills import DRILLS, Outcome, drill_plants, run_drill
from tests.rig.fault_injection.host_drills import HOST_DRILLS, HostOutcome, run_host_drill

HEALTHY, TARGETS = 6, (36.0, 20.0, 40.0, 30.0)  # sessions that a guard learns from, in turn to [degC]
WEAKER = 0.02  # of its current a driver loses from session to session
SHARES = (0.9, 0.8, 0.6, 0.4)  # of the floors: what sooner would cost
_MODEL_IN = "floor"  # in the reason of a drill that a window against the model finds

# ruff: noqa: E501
HEAD = """\
# What happens when something fails

Every line is a test (`tests/rig/fault_injection/test_drills.py`) on a virtual device behind a real pseudo-terminal; this
page is written by `python benchmarks/rig/faults.py --out docs/reference/faults.md --record docs/records/faults.md
--nominal nominal.json --day day.txt`. The device's plant is a few percent off the model that guard and controller know; the room is 25 degC, the
skin is on its way from 25 to 36 degC or, where marked *held*, was there.

- **found**: from the fault to the trip, by the device's clock. A sample is 1 s, and the fault comes between two.
- **off**: from the trip to zero drive at the module. Where the host is dead or the cable out no line of ours
  runs: there it is the time from the fault, and the device's own 2 s end it.
- **beyond**: how far the true temperatures of water and skin left the range of a session without the fault.
- **rows**: on disk afterwards. None was lost and none is wrong, in every line: before the fault each is the truth
  within noise; what a broken sensor said is on disk as it said it.

**A TCLab cannot do this.** Its firmware has no time to live: if its host dies, or its cable is pulled, it heats on
until somebody pulls the supply. Everything that the host can see is watched on it as well.

**A board that was exchanged is not driven.** After a silence or a new connection our firmware is known by its serial
number, older firmware and a TCLab by that of their USB interface. Where that has none, a TCLab is known by a heater that
still is as it was set, and with its heaters off not at all: the session ends as `cable`.

| fault | found after [s] | by | off after [s] | beyond [K] | rows |
|---|---|---|---|---|---|
"""

SLOW = """
## How far beyond a limit

## Why some take their time

Sooner is lower floors, or fewer repeats, at the cost of false alarms. {cost}

Floors are what a window against the model may be off by where the model predicts no change: {floors}; a quarter of
the change comes on top. [What lower floors cost](../records/faults.md), how long faults take at any moment of a session,
and what a drift of the plant costs, are in the records.

A session that does not begin at rest (after a trip, say) compares nothing with the model in its first 60 s, for what
cannot be read, a hot heatsink, is not known yet; nor is a skin compared for 60 s after a touch. What fails then is found
at the end of that and a window; sensors that are lost or jump, limits, pump and cable are seen at once all the same.

What is found late did no harm meanwhile: with none of these drills the water or the skin left its range by more than
{worst:.1f} K, and no grasp is taken before the skin has been compared with the model for a whole window.
"""

RECORD = """\
# What finding faults sooner would cost

Written with [the page of faults](../reference/faults.md), by `python benchmarks/rig/faults.py`. With lower floors the
same faults are found so much sooner, and healthy sessions are ended:

| found after [s] with floors | {heads} | why not sooner |
|---|{rules}---|
{rows}

Repeats of a sensor are another matter: {repeats}
{day}"""

UNSEEN = """
## What no sensor can show

**Sensors that drift together** look like a rig that loses a little more heat, or less. The guard lets a drive be off by 15 % of what is asked for (three times what gains differ by from run to run) and by the error of its own estimate, not by more. When skin and tank come to read 10 K too little within an hour (20 degC: too much), on this rig:

| held at [degC] | found when they are off by [K] | the true skin is then at [degC] |
|---|---|---|
{rows}

So leave that much room below what must not be exceeded, or have one of two sensors read by another converter (`[[pairs]]`).

**Without a model** (`record`), no sensor that reads the room is found out before 60 s of full drive have been given, or as much of a lower drive; a mean drive of less than 1/16 is not judged. On this rig water and skin are then {beyond:.1f} K from the room at most. While another sensor answers, one that has come off its place is found by a pair alone; and without a sensor of the room only once none has moved by 1 K since the session began.
"""

SAID = """
## Messages

One line on the terminal, the same as JSON in `events.jsonl` and `run.json`. Two of them:

"""

TAIL = """
## Every kind of trip

| kind | check | to clear |
|---|---|---|
"""


WRONG = """
**All this holds for a plant that is known as well as its fit says.** On {rigs} rigs whose every parameter is wrong by up to {share:g} % besides (`--off {off:g}`), without a fault, the guard ended {n} of {sessions} sessions in {hours:.0f} h. Such trips say `driver` or `reversed` and name the driver, the pump or the module. A rig that was changed, or a plant from somebody else's logs, has to be identified anew, or be given wider floors and a wider `drive_limit` in a [guard file](../howto/rig.md).
"""

DRIFTED = """
**So a drift may be stated.** `drift = {share:g}` in its file allows each parameter to be off by {percent:g} %, and `--learn` besides learns where from healthy sessions. On rigs as wrong as that it then ended {n} of {sessions} sessions in {hours:.0f} h.
"""

LEARNT = """
What a stated drift costs: the same faults are found so much later with a drift of 5 % of which nothing is known yet, and after {healthy} healthy sessions on the very device:

| found after [s] | plant as identified | drift 5 % | learnt |
|---|---|---|---|
{rows}

And what cannot be learnt away: a driver that gives {step:g} % less current in each session, no session being healthy, is found when {usual:g} % are gone as identified, {young:g} % where the guard learns from the first of them on, {old:g} % where it had learnt before.
"""

ALONE = """
Where nothing on the device ends its drive (a TCLab), this clears instead:

"""


def main() -> None:
    """Run every drill and write the page."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--record", type=Path)
    parser.add_argument("--nominal", type=Path, nargs="*", default=[])
    parser.add_argument("--day", type=Path)
    options = parser.parse_args()
    out: Path = options.out
    controller = PIController(drill_plants()[0], dt=1.0)
    outcomes, hosts = [], []
    sooner: dict[float, dict[str, float]] = {share: {} for share in SHARES}
    with tempfile.TemporaryDirectory() as folder:
        for k, drill in enumerate(DRILLS):
            hold = 400.0 if drill.kinds else 60.0
            outcomes.append(run_drill(drill, controller, Path(folder) / f"d{k}", hold=hold))
            print(_row(outcomes[-1]), flush=True)
            if options.nominal and _MODEL_IN in drill.why:
                for share in SHARES:
                    where = Path(folder) / f"d{k}-{share}"
                    lower = run_drill(drill, controller, where, hold=hold, settings=_lower(share))
                    sooner[share][drill.name] = lower.detected
        for k, host in enumerate(HOST_DRILLS):
            hosts.append(run_host_drill(host, Path(folder) / f"h{k}"))
            print(_host_row(hosts[-1]), flush=True)
    lines = [_row(one) for one in outcomes] + [_host_row(one) for one in hosts]
    if not options.nominal:
        page, last = out.read_text(encoding="utf-8"), HEAD[HEAD.rindex("| fault") :]
        before, _, rest = page.partition(last)
        after = rest[rest.index("\n\n") :]
        out.write_text(before + last + "\n".join(lines) + after, encoding="utf-8")
        return
    nominal = [json.loads(path.read_text(encoding="utf-8")) for path in options.nominal]
    healthy = [run for run in nominal if not run["off"] and not run.get("drift")]
    slow, record = _slow(outcomes, sooner, _merged(healthy), options.day)
    wrong = [run for run in nominal if run["off"]]
    stated = [run for run in wrong if run.get("drift")]
    slow += "".join(
        WRONG.format(**run, n=len(run["trips"]), share=100 * run["off"]) for run in wrong if run not in stated
    )
    for run in stated:
        share, n = run["drift"], len(run["trips"])
        slow += DRIFTED.format(
            share=share, percent=100 * share, n=n, sessions=run["sessions"], hours=run["hours"]
        )
    record += drift_section(controller, outcomes) if stated else ""
    slow += unseen(controller)
    said = [f"    {o.message}" for o in outcomes if o.drill.name in ("pump stops", "driver gives nothing")]
    kinds = [f"| `{kind}` | {check} | {clear} |" for kind, (check, clear) in KINDS.items()]
    text = HEAD + "\n".join(lines) + "\n" + slow + SAID + "\n\n".join(said) + "\n"
    ends = [f"- `{kind}`: {clear}" for kind, clear in ENDLESS.items()]
    text += TAIL + "\n".join(kinds) + "\n" + ALONE + "\n".join(ends) + "\n"
    out.write_text(with_limits(_tidy(text)), encoding="utf-8")
    options.record.write_text(_tidy(record), encoding="utf-8")


class Together(Twin):
    """A rig all of whose outputs are off by so many K per hour after half an hour, or read the room."""

    off_place, rate = False, -10.0

    def read(self) -> Reading:
        """Return what the sensors show."""
        found, room = super().read(), self.ambient
        off = self.rate * max(self.time / 3600 - 0.5, 0.0)
        values = {name: room if self.off_place else value + off for name, value in found.values.items()}
        return replace(found, values={**values, "t_ambient": room})


class Constant:
    """A controller that asks for one drive."""

    def __init__(self, drive: float) -> None:
        self.drive, self.dt = drive, 1.0

    def reset(self, reading: Readings) -> None: ...

    def step(self, reading: Readings, target: Target) -> Move:
        """Return the move."""
        return Move(drive=self.drive)


def unseen(controller: PIController) -> str:
    """Return how far sensors that are wrong together lead, until that is found."""
    rows, (known, real) = [], drill_plants()
    for target in (46.0, 36.0, 20.0):
        rig = Together(real, ambient=25.0, seed=1)
        rig.rate = -10.0 if target > 25.0 else 10.0
        trip = run_session(rig, controller, target, hold=7200.0, guard=Guard(known)).trip
        off = "never" if trip is None else f"{10 * (rig.time / 3600 - 0.5):.1f}"
        rows.append(f"| {target:g} | {off} | {rig.truth()['t_surface']:.1f} |")
        print(rows[-1], trip and trip.line(), flush=True)
    beyond = []
    for drive in (1.0, 0.49, 0.25, 0.1, 0.06, -0.06, -0.25, -1.0):
        rig = Together(real, ambient=25.0, seed=1)
        rig.off_place = True
        run_session(rig, Constant(drive), 35.0, guard=Guard(), settle_timeout=7200.0)
        beyond.append(max(abs(value - rig.ambient) for value in rig.truth().values()))
        print(f"no model, drive {drive:g}: {beyond[-1]:.1f} K after {rig.time:.0f} s", flush=True)
    return UNSEEN.format(rows="\n".join(rows), beyond=max(beyond))


def drift_section(controller: PIController, outcomes: Sequence[Outcome]) -> str:
    """Return what a stated drift costs in time, and what cannot be learnt away."""
    rows, known = [], drill_plants()[0]
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        learnt = _after_sessions(controller, folder / "rig.json")
        unknown = PlantDrift.unknown(known, 0.05)
        for k, one in enumerate(outcomes):
            if one.session.trip is None or one.drill.why == "" or "tachometer" in one.drill.why:
                continue
            found = [
                run_drill(one.drill, controller, folder / f"{k}-{kind}", hold=400.0, drift=drift).detected
                for kind, drift in (("unknown", unknown), ("learnt", learnt))
            ]
            times = " | ".join(f"{seconds:.1f}" for seconds in (one.detected, *found))
            rows.append(f"| {one.drill.name} | {times} |")
            print(rows[-1], flush=True)
        gone = [_gone(controller, drift, folder / "weak.json") for drift in (None, unknown, learnt)]
    usual, young, old = (100 * share for share in gone)
    rows_said = "\n".join(rows)
    return LEARNT.format(
        healthy=HEALTHY, rows=rows_said, step=100 * WEAKER, usual=usual, young=young, old=old
    )


def _after_sessions(controller: PIController, file: Path) -> PlantDrift:
    """Return what healthy sessions on the device teach."""
    known, real = drill_plants()
    guard = Guard(known, drift=PlantDrift.unknown(known, 0.05, file=file))
    for k in range(HEALTHY):
        rig = Twin(real, ambient=25.0, seed=k)
        session = run_session(rig, controller, TARGETS[k % len(TARGETS)], hold=60.0, guard=guard)
        assert session.trip is None, session.trip.line()
    assert guard.model is not None
    assert guard.model.drift is not None
    return guard.model.drift


def _gone(controller: PIController, drift: PlantDrift | None, file: Path) -> float:
    """Return how much of its current a driver has lost when it is found; inf where it never is."""
    known, real = drill_plants()
    guard = Guard(known, drift=None if drift is None else replace(drift, file=file))
    for k in range(1, round(0.8 / WEAKER)):
        values = real.values | {"current": real.values["current"] * (1 - WEAKER * k)}
        rig = Twin(replace(real, values=values), ambient=25.0, seed=k)
        session = run_session(rig, controller, TARGETS[k % len(TARGETS)], hold=60.0, guard=guard)
        if session.trip is not None:
            print(f"lost {WEAKER * k:.2f}: {session.trip.line()}", flush=True)
            return WEAKER * k
    return float("inf")


def _lower(share: float) -> GuardSettings:
    """Return settings whose floors are a share of the default ones."""
    usual = ModelSettings()
    floors = tuple(share * floor for floor in usual.floors)
    return GuardSettings(model=replace(usual, floors=floors))


def _merged(runs: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the sums of what nominal.py wrote."""
    total: dict[str, Any] = {key: sum(run[key] for run in runs) for key in ("hours", "sessions", "rigs")}
    total["trips"] = sum(len(run["trips"]) for run in runs)
    ended = [run["sessions_that_lower_floors_would_end"] for run in runs]
    return total | {"ended": {float(share): sum(one[share] for one in ended) for share in ended[0]}}


def _slow(
    outcomes: Sequence[Outcome],
    sooner: dict[float, dict[str, float]],
    nominal: dict[str, Any],
    day: Path | None,
) -> tuple[str, str]:
    """Return the section on what takes its time, and the record of what less would cost."""
    most = 24 * float(chi2.ppf(0.95, 2 * (nominal["trips"] + 1))) / (2 * nominal["hours"])
    cost = (
        f"In {nominal['hours']:.0f} h of sessions without a fault on {nominal['rigs']} rigs (posterior draws of a plant, "
        f"of which the guard knows the fit alone; `benchmarks/rig/nominal.py`) {_tripped(nominal['trips'])}: "
        f"at most {most:.1f} times a day, at 95 %."
    )
    table = ""
    if day is not None:
        said = json.loads("{" + day.read_text(encoding="utf-8").partition("\n{")[2])
        n, hours = len(said["false_alarms"]), said["simulated_h"]
        least = 24 * float(chi2.ppf(0.95, 2 * (n + 1))) / (2 * hours)
        cost += (
            f" In {hours:.1f} h with a fault every ten minutes (`benchmarks/rig/day.py --seed {said['seed']} "
            f"--draw {said['draw']}`) {_tripped(n)} without one: at most {least:.1f} times a day."
        )
        table = _of_the_day(said)
    rows = []
    for one in outcomes:
        name, why = one.drill.name, one.drill.why
        if why:
            found = [f"{sooner[share][name]:.1f}" if name in sooner[share] else "" for share in SHARES]
            rows.append(f"| {name} | {one.detected:.1f} | {' | '.join(found)} | {why} |")
    ended = " | ".join(f"{nominal['ended'][share]}" for share in (1.0, *SHARES))
    rows.append(f"| *healthy sessions of {nominal['sessions']} that they end* | {ended} | |")
    noise, quantum = SensorSettings().noise, 1 / 16
    needed = {alpha: repeats_needed(quantum, noise, alpha) for alpha in (1e-9, 1e-6, 1e-4)}
    repeats = (
        f"with noise of {noise:g} K in steps of 1/16 K a healthy sensor says the same {needed[1e-9]:.0f} times in a row "
        f"once in 10^9 readings, {needed[1e-6]:.0f} times once in 10^6 (three sensors, 1 Hz: every four days), "
        f"{needed[1e-4]:.0f} times once in 10^4 (every hour)."
    )
    usual = ModelSettings()
    floors = ", ".join(f"{f:g} K in {w:g} s" for f, w in zip(usual.floors, usual.windows))
    section = SLOW.format(cost=cost, floors=floors, worst=max(o.excursion for o in outcomes if o.drill.why))
    record = RECORD.format(
        heads=" | ".join(f"x {share:g}" for share in (1.0, *SHARES)),
        rules="---|" * (1 + len(SHARES)),
        rows="\n".join(rows),
        repeats=repeats,
        day=table,
    )
    return section, record


def _of_the_day(said: dict[str, Any]) -> str:
    """Return how long the slow faults of a day took, at whatever moment they came."""
    rows = [
        f"| {_plainly(fault)} | {median:g} | {longest:g} |"
        for fault, (median, longest) in said["detected_after_s_median_max"].items()
        if fault.startswith(("sensor_stuck", "sensor_drift", "sensor_lag", "sensor_offset", "driver_stuck"))
    ]
    accepted = sum(said["accepted_while_a_fault_was_on"].values())
    return f"""
So, at whatever moment they came in the {said["simulated_h"]:.0f} h with faults, of which each was repaired after a minute
in which nobody noticed it ({accepted} of the {said["grasps"]} grasps were taken with a fault on; the skin of every grasp
was right to {said["largest_error_of_an_accepted_grasp_K"]:g} K):

| fault, where it was found in its minute | found after [s], median | longest |
|---|---|---|
{chr(10).join(rows)}
"""


def _plainly(fault: str) -> str:
    """Return the name of a fault without the braces of its options."""
    return re.sub(r"\s*\{'(\w+)': (\S+)\}", r", \1 \2", fault)


def _tidy(text: str) -> str:
    """Return the page with paragraphs that are too wide filled anew; tables and lists stay."""
    parts = text.split("\n\n")
    for k, part in enumerate(parts):
        if part[:1] not in ("|", " ", "-") and max(map(len, part.splitlines()), default=0) > 120:
            parts[k] = fill(part, 118, break_long_words=False, break_on_hyphens=False)
    return "\n\n".join(parts)


def _tripped(n: int) -> str:
    often = ("it never tripped", "it tripped once", "it tripped twice")
    return often[n] if n < 3 else f"it tripped {n} times"


def _row(one: Outcome) -> str:
    name = one.drill.name + (", held" if one.drill.at > 100 and "held" not in one.drill.name else "")
    beyond = f"{max(one.excursion, 0.0):.1f}"
    if one.session.trip is None:
        return f"| {name} | - | the session goes on: {one.session.verdict} | - | {beyond} | {one.rows} |"
    off = f"{one.off:.1f}" if one.off <= 0.1 else f"{one.detected + one.off:.1f} from the fault"
    return f"| {name} | {one.detected:.1f} | `{one.session.trip.kind}` | {off} | {beyond} | {one.rows} |"


def _host_row(one: HostOutcome) -> str:
    trip = one.run.about.get("trip")
    by = f"`{trip['kind']}`" if trip else {"running": "the device alone"}.get(one.run.about["verdict"], "")
    by = by or ("refused; the first goes on" if "second" in one.drill.name else "power off on the way out")
    off = f"{one.off:.1f} from the fault"
    return f"| {one.drill.name} | - | {by} | {off} | {max(one.excursion, 0.0):.1f} | {one.rows} |"


if __name__ == "__main__":
    main()
