"""The time of each row: units by behaviour, counters that wrap, boards that begin again, programs."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from thermogrip.datasets.log_files import read_log
from thermogrip.datasets.schema import column

RNG = np.random.default_rng(0)
ROWS = 120
HEATER = np.repeat(RNG.integers(0, 2, ROWS // 8), 8) * 60.0
PLATE = 20 + np.cumsum(HEATER) * 0.01 + 0.05 * RNG.standard_normal(ROWS)


def log_of(tmp_path, clock, header="time"):
    """Return the log of a file with these cells in its clock."""
    head = "" if header is None else f"{header},heater_percent,t_plate_degC\n"
    rows = [f"{stamp},{drive:g},{reading:.2f}\n" for stamp, drive, reading in zip(clock, HEATER, PLATE)]
    (tmp_path / "log.csv").write_text(head + "".join(rows))
    columns = ["-", "heater_percent", "t_plate_degC"] if header == "-" else None
    return read_log(tmp_path / "log.csv", columns=columns)


def stamped(form):
    return pd.date_range("2024-02-28 18:00", periods=ROWS, freq="1801s").strftime(form)


def jittered(step, first=0):
    """Return the counts of a board that is a few of them late now and then."""
    return first + step * np.arange(ROWS) + RNG.integers(0, 4, ROWS)


@pytest.mark.parametrize(
    ("header", "counts", "step", "doubt"),
    [
        ("time_s", 2 * np.arange(ROWS), 2.0, ""),
        ("time", 2 * np.arange(ROWS), 2.0, "rows are 2 s apart"),
        ("t", 2 * np.arange(ROWS) + 0.001 * RNG.integers(0, 9, ROWS), 2.0, ""),  # a program's loop
        ("seconds", 300 * np.arange(ROWS), 300.0, ""),
        ("millis", jittered(500), 0.5, ""),
        ("time", jittered(500), 0.5, "taken as milliseconds"),
        ("timestamp", jittered(992, first=1_200_000_000), 0.992, "taken as milliseconds"),  # since it was on
        ("time", jittered(250_000), 0.25, "taken as microseconds"),
        ("timestamp", jittered(500, first=1_700_000_000_000), 0.5, ""),
        ("uptime", jittered(1000), 1.0, "taken as milliseconds"),
        ("c1", jittered(500), 0.5, "taken as milliseconds"),
        ("row", np.arange(ROWS), 1.0, "rows are 1 s apart"),
        ("elapsed_s", 10 * (np.arange(ROWS) // 2), 5.0, ""),  # of few digits
        ("Ticks", 638_000_000_000_000_000 + 2 * 10**7 * np.arange(ROWS), 2.0, ""),  # of .NET
        ("c1", 4 * np.arange(ROWS) + np.arange(ROWS) % 3, 5.0, "so that rows are 5 s apart"),
        ("c1", (2**32 - 2_000_000 + 50_000 * np.arange(ROWS)) % 2**32, 0.05, "taken as microseconds"),
        ("Year,Month,Day,Hour,Minute,Second", stamped("%Y,%m,%d,%H,%M,%S"), 1801.0, ""),
        ("YY,MM,DD,hh,mm,ss", stamped("%y,%m,%d,%H,%M,%S"), 1801.0, ""),
        ("Day,Hour,Minute,Second", stamped("%d,%H,%M,%S"), 1801.0, ""),  # over the end of a month
        ("Hour", (20 + 0.04 * np.arange(ROWS)).round(2) % 24, 144.0, ""),
        ("seconds_of_day", (86_000 + 5 * np.arange(ROWS)) % 86_400, 5.0, ""),
        ("Time (weeks)", 0.01 * np.arange(ROWS), 6048.0, ""),
        ("elapsed", [f"{k // 120:02}:{k / 2 % 60:04.1f}" for k in range(ROWS)], 0.5, "minutes and seconds"),
        ("time_s", np.r_[np.arange(60), [60] * 9, np.arange(61, 112)], 1.0, "time stands still: 8 repeated"),
        ("c1", 1_700_000_000_000 + np.cumsum(np.tile([150, 400, 400, 2000], ROWS // 4)), 0.4, ""),
    ],
)
def test_a_clock_is_known_by_its_name_or_its_behaviour_and_a_guess_is_a_doubt(
    tmp_path, header, counts, step, doubt
):
    log = log_of(tmp_path, counts, header)
    assert np.median(np.diff(log["time"].values)) == pytest.approx(step, rel=0.01)
    assert list(log) == ["heater", "t_plate"]
    assert (doubt in log.attrs["clock_doubts"]) if doubt else log.attrs["clock_doubts"] == ""


def test_a_file_without_a_clock_is_a_doubt_and_a_stated_step_is_none(tmp_path):
    (tmp_path / "log.csv").write_text("heater,t_a\n" + "".join(f"{k % 2},{20 + k % 3}\n" for k in range(30)))
    assert "rows are taken 1 s apart" in read_log(tmp_path / "log.csv").attrs["clock_doubts"]
    assert read_log(tmp_path / "log.csv", dt=0.5).attrs["clock_doubts"] == ""


def test_tables_side_by_side_with_clocks_of_other_rates_are_a_doubt(tmp_path):
    beside = [f"{5 * k},{k % 2}" if k < 40 else "," for k in range(100)]
    rows = "".join(f"{2 * k},{20 + k % 3},{cells}\n" for k, cells in enumerate(beside))
    (tmp_path / "log.csv").write_text("Time (s),Tank (C),Time (s),Heater (%)\n" + rows)
    assert "2_Time (s) goes 5 s a row, not 2" in read_log(tmp_path / "log.csv").attrs["clock_doubts"]


@pytest.mark.parametrize("bits", [16, 32])
@pytest.mark.parametrize(("header", "count"), [("millis", 1e-3), ("micros", 1e-6), ("time_s", 1e-3)])
def test_a_counter_that_wraps_goes_on(tmp_path, bits, header, count):
    step = 500
    counts = (2**bits - 40 * step + step * np.arange(ROWS)) % 2**bits
    stamps = counts * count if header == "time_s" else counts
    log = log_of(tmp_path, stamps, header)
    np.testing.assert_allclose(np.diff(log["time"].values), step * count, rtol=1e-6)
    assert f"a counter of {bits} bits wrapped in row 42: it goes on" in log.attrs["repairs"]


def test_a_board_that_was_reset_begins_a_new_segment_after_a_gap(tmp_path):
    counts = np.r_[np.arange(70), np.arange(2, 52)] * 1000
    log = log_of(tmp_path, counts, "millis")
    steps = np.diff(log["time"].values)
    assert np.flatnonzero(steps > 10).tolist() == [69]
    np.testing.assert_allclose(np.delete(steps, 69), 1.0)
    assert "the clock starts again in row 72: new segments" in log.attrs["repairs"]
    assert "the clock starts again in row 71" in log_of(tmp_path, counts, None).attrs["repairs"]


def printer(k):
    readings = f"T:{PLATE[k]:.2f} /200.00 B:24.77 /0.00 @:{HEATER[k]:g} B@:0"
    return f"2024-05-04 12:30:{k % 60:02},123 - Recv:  {readings}\n"


def klipper(k):
    part = f"extruder: target=200 temp={PLATE[k]:.2f} pwm={HEATER[k] / 60:.3f}"
    return f"Stats {1000 + 2 * k}.5: gcodein=0  mcu: mcu_awake=0.00{k % 7} freq=16000135 {part}\n"


@pytest.mark.parametrize(
    ("line", "chatter", "step", "columns"),
    [
        (printer, "2024-05-04 12:30:00,500 - Send: N0 M105*0\n", 1.0, ("@", "T", "T_target")),
        (klipper, "webhooks client 140: New connection\n", 2.0,
         ("extruder_pwm", "extruder_temp", "extruder_target")),
    ],
)  # fmt: skip
def test_lines_of_a_printer_are_read_with_their_stamps_targets_and_duties(
    tmp_path, line, chatter, step, columns
):
    drive, reading, target = columns
    text = "".join(line(k) + (chatter if k % 4 == 0 else "") for k in range(60))
    (tmp_path / "host.log").write_text(text)
    log = read_log(tmp_path / "host.log")
    assert np.median(np.diff(log["time"].values)) == step
    assert log[drive].attrs["role"] == "input"
    assert (log[reading].attrs["role"], log[target].attrs["role"]) == ("output", "other")
    np.testing.assert_allclose(column(log, reading), np.round(PLATE[:60], 2))
    assert "15 line(s) without them passed over" in log.attrs["repairs"]


@pytest.mark.parametrize(("on", "off"), [("on", "off"), ("True", "False"), ("heating", "idle")])
def test_words_beside_stamps_with_a_space_are_a_switch(tmp_path, on, off):
    cells = {30: "60.0\u00b0C", 31: "NAN"}
    relay = [cells.get(k, on if k % 3 else off) for k in range(60)]
    rows = [f"2024-01-13 0:0:{k},{relay[k]},{20 + k / 8:.4f},6.0\n" for k in range(60)]
    (tmp_path / "hub.csv").write_text("timestamp,relay,room,outside\n" + "".join(rows))
    log = read_log(tmp_path / "hub.csv")
    assert column(log, "relay")[[*range(4), 30, 31]].tolist() == [0, 1, 1, 0, 1, 1]
    assert log["time"].values[-1] == 59
    assert log["outside"].attrs["role"] == "disturbance"


def test_milliseconds_behind_a_comma_between_commas_are_of_their_stamp(tmp_path):
    rows = [f"2024-05-04 12:30:{k:02},{25 * k % 1000:03},{PLATE[k]:.2f},{HEATER[k]:g}\n" for k in range(60)]
    for header, step in (("asctime,plate,heater", 1.025), ("asctime,code,plate,heater", 1.0)):
        (tmp_path / "log.csv").write_text(f"{header}\n{''.join(rows)}")
        log = read_log(tmp_path / "log.csv")
        assert np.median(np.diff(log["time"].values)) == pytest.approx(step)
        np.testing.assert_allclose(column(log, "plate"), np.round(PLATE[:60], 2))


def test_states_in_words_are_columns_of_0_and_1_but_for_rest(tmp_path):
    states = ("Idle", "Cooling", "Heating", "Waiting to cool")
    rows = [f"12.09.2024 08:{k:02}:00,{20 + k / 16},19.0,{states[k // 8 % 4]}\n" for k in range(60)]
    (tmp_path / "brew.csv").write_text("Time,BeerTemp,BeerSet,State\n" + "".join(rows))
    log = read_log(tmp_path / "brew.csv")
    assert log["BeerSet"].attrs["role"] == "other"
    states_found = [str(name).removeprefix("State_") for name in log if "State" in str(name)]
    assert states_found == ["Cooling", "Heating", "Waiting_to_cool"]
    assert column(log, "State_Cooling")[[0, 8, 16]].tolist() == [0, 1, 0]
    assert "State_Cooling is taken as input" in log.attrs["role_doubts"]


def row(k):
    return f"{PLATE[k]:.2f},{HEATER[k]:g}"


LABVIEW = (
    "LabVIEW Measurement\t\nSeparator\tTab\nDate\t2024/02/11\n***End_of_Header***\t\n\t\nChannels\t2\t\t\n"
    "Samples\t60\t60\t\nDelta_X\t0.5\t0.5\t\n***End_of_Header***\t\t\t\n"
    "X_Value\tplate_temp\theater\tComment\n"
)


@pytest.mark.parametrize(
    ("name", "head", "line", "step"),
    [
        ("a.lvm", LABVIEW, lambda k: f"{k / 2}\t{row(k).replace(',', chr(9))}\n", 0.5),
        ("putty.log", "=~=~= PuTTY log 2024.03.01 22:55:39 =~=~=\nplate_temp,heater\n",
         lambda k: f"[2024-03-01 22:55:{k:02}] {row(k)}\n", 1.0),
        ("monitor.txt", "12:00:00.000 -> plate_temp heater\n",
         lambda k: f"12:00:{k:02}.250 -> {row(k).replace(',', ' ')}\n", 1.0),
        ("esphome.log", "[06:00:00][I][app:102]: ESPHome version 2024.2\n",
         lambda k: f"[06:00:{k:02}][D][sensor:094]: 'plate_temp': Sending state {PLATE[k]:.2f} \u00b0C with\n"
                   f"[06:00:{k:02}][D][number:012]: 'heater': Sending state {HEATER[k]:.1f}\n", 1.0),
        ("klippy.log", "Loaded MCU 'mcu'\n" + "[gcode_macro PRIME]\ngcode: M104 S200\n" * 750,
         lambda k: f"Stats {1200 + 2 * k}.3: heater: target=0 temp={PLATE[k]:.2f} pwm={HEATER[k]:g} "
                   f"sysload=0.3{k % 7} cputime={k / 20:.3f}\n", 2.0),
    ],
)  # fmt: skip
def test_logs_of_programs_are_read_with_their_clocks(tmp_path, name, head, line, step):
    (tmp_path / name).write_text(head + "".join(line(k) for k in range(60)))
    log = read_log(tmp_path / name)
    assert np.median(np.diff(log["time"].values)) == step
    reading, drive = ("heater_temp", "heater_pwm") if name == "klippy.log" else ("plate_temp", "heater")
    roles = {
        str(n): v.attrs["role"] for n, v in log.items() if v.attrs["role"] not in ("other", "disturbance")
    }
    assert roles == {reading: "output", drive: "input"}
    assert not {"sysload", "cputime"} & {*log}
    np.testing.assert_allclose(column(log, reading), np.round(PLATE[: log.sizes["time"]], 2))


def test_each_start_of_labview_s_first_column_is_a_part(tmp_path):
    starts = [*range(12), *range(36), *(6 * [*range(12)])]
    rows = "".join(f"{t}\t{HEATER[k]:g}\t{PLATE[k]:.2f}\n" for k, t in enumerate(starts))
    head = "LabVIEW Measurement\t\nX_Columns\tOne\n***End_of_Header***\t\n"
    (tmp_path / "pulses.lvm").write_text(head + rows)
    log = read_log(tmp_path / "pulses.lvm")
    ends = np.flatnonzero(np.diff(log["time"]) > 10).tolist()
    assert (list(log), ends) == (["c2", "c3"], [11, *range(47, 119, 12)])
    assert log.attrs["repairs"].endswith("\n2 more gaps, the longest 11.00 s")
    part = "***End_of_Header***\t\n" + rows
    (tmp_path / "twice.lvm").write_text(head + part + part)
    assert "has 2 parts with headings: only the last" in read_log(tmp_path / "twice.lvm").attrs["role_doubts"]
    (tmp_path / "twice.lvm").write_text(head + part + "***End_of_Header***\t\n0\t1\t2\n")
    with pytest.raises(ValueError, match="are not a log; has 2 parts with headings"):
        read_log(tmp_path / "twice.lvm")


def test_a_kiln_s_log_keeps_the_reading_that_has_a_blank_before_its_sign(tmp_path):
    stamp = "Jan 21 06:{:02}:{:02} pi python[286]: 2019-01-21 06:25:40,390 INFO oven: "
    drive = np.repeat([1.0, 0.2, 0.7], 20)
    cells = "temp ={:.2f}, target=90.0, pid={}, run_time={}\n"
    rows = [stamp.format(*divmod(2 * k, 60)) + cells.format(PLATE[k], drive[k], 2 * k) for k in range(60)]
    (tmp_path / "daemon.log").write_text("".join(rows))
    log = read_log(tmp_path / "daemon.log")
    roles = {str(name): item.attrs["role"] for name, item in log.items()}
    assert roles == {"oven_temp": "output", "oven_target": "other", "pid": "input"}
    np.testing.assert_allclose(column(log, "oven_temp"), np.round(PLATE[:60], 2))


def test_a_roaster_s_minutes_and_seconds_are_its_clock_and_its_events_no_states(tmp_path):
    events = {5: "Charge", 40: "Dry End", 90: "Drop"}
    for without in ("", "None"):  # a log of a fermenter writes a word in rows without a note
        rows = [
            f"{k // 60:02}:{k % 60:02}\t{PLATE[k]:.2f}\t{events.get(k, without)}\t{60 + 20 * (k // 40 % 2)}\n"
            for k in range(120)
        ]
        (tmp_path / "roast.csv").write_text("Time1\tBT_degC\tEvent\tGas_percent\n" + "".join(rows))
        log = read_log(tmp_path / "roast.csv")
        assert (float(log["time"][-1]), list(log)) == (119.0, ["BT", "Gas"])
        assert "Time1 is taken as minutes and seconds" in log.attrs["clock_doubts"]


def test_a_hub_s_switch_is_read_though_its_words_are_few_beside_the_readings(tmp_path):
    moment = "2024-02-11T06:{:02}:{:02}.000Z"
    readings = [f"sensor.hall,{PLATE[k]:.2f},{moment.format(k // 60, k % 60)}\n" for k in range(120)]
    switch = [f"switch.heater,{word},{moment.format(at // 60, at % 60)}\n"
              for word, at in (("off", 0), ("on", 40), ("off", 80))]  # fmt: skip
    (tmp_path / "history.csv").write_text("entity_id,state,last_changed\n" + "".join(switch + readings))
    assert column(read_log(tmp_path / "history.csv"), "heater")[[0, 45, 85]].tolist() == [0, 1, 0]


def test_a_clock_with_a_unit_needs_no_english_name(tmp_path):
    rows = [f"{2 * k};{PLATE[k]:.2f}\n".replace(".", ",") for k in range(60)]
    (tmp_path / "four.csv").write_text("temps (s);four (\u00b0C)\n" + "".join(rows))
    log = read_log(tmp_path / "four.csv")
    assert np.all(np.diff(log["time"].values) == 2)
    assert log.attrs["clock_doubts"] == ""
