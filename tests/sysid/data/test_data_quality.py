"""Each check of the data finds the fault that was planted, and stays silent without it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from thermogrip.datasets.examples import load_example_logs
from thermogrip.datasets.schema import make_log
from thermogrip.sysid.data.data_quality import check_data, evidence, reading_excess
from thermogrip.sysid.greybox.problem import prior_plant
from thermogrip.sysid.models.network import load_network
from thermogrip.sysid.plant.log_grid import rows_of


def plant_log(n=2000, *, seed=0, noise=0.02, level=25.0, name="a", drift=0.0, q=None, time=None):
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.random(n // 25) - 0.5, 25) if q is None else q
    y = level + drift * np.arange(n) / n + lfilter([0, 0.5], [1, -0.95], u) + noise * rng.standard_normal(n)
    t = np.arange(float(n)) if time is None else time
    return make_log(t, {"q": (u, "1", "input"), "t": (y, "degC", "output")}, name=name)


def covered(plant, logs):
    return evidence(plant, [rows_of(log, plant.inputs, plant.outputs, ()) for log in logs])


def one(logs, check, **how):
    found = check_data(logs, average=1.0, **how).of(check)
    return max(found, key=lambda f: {"ok": 0, "warn": 1, "fail": 2}[f.verdict])


def test_a_clean_log_is_ok_throughout():
    assert {f.verdict for f in check_data([plant_log()], average=1.0).findings} == {"ok"}


def test_a_controller_in_the_loop_is_found():
    rng = np.random.default_rng(3)
    n = 2000
    target = np.repeat(rng.random(n // 100), 100)
    u, y = np.zeros(n), np.zeros(n)
    for k in range(n):
        y[k] = (0.95 * y[k - 1] + 0.05 * u[k - 1] if k else 0) + 0.02 * rng.standard_normal()
        u[k] = 2.0 * (target[k] - y[k])
    log = make_log(np.arange(float(n)), {"q": (u, "V", "input"), "t": (y, "degC", "output")})
    found = one([log], "feedback")
    assert found.verdict == "warn"
    assert "closed loop" in found.says


def test_a_controller_is_found_between_the_steps_of_its_set_point():
    rng, total = np.random.default_rng(2), 0.0
    y, read, u = np.full(1500, 20.0), np.zeros(1500), np.zeros(1500)
    for k in range(1500):
        read[k] = y[k] + 0.05 * rng.standard_normal()
        error = (40.0, 60.0, 50.0)[k // 500] - read[k]
        total = min(max(total + 0.1 * error, 0.0), 100.0)
        u[k] = np.clip(8 * error + total, 0, 100)
        y[k + 1 :] = y[k] + 0.02 * (20 + 0.8 * u[k] - y[k])
    log = make_log(np.arange(1500.0), {"q": (u, "1", "input"), "t": (read, "degC", "output")})
    assert "closed loop" in one([log], "feedback").says


@pytest.mark.parametrize("closed", [True, False])
def test_a_thermostat_is_known_by_the_readings_at_which_it_switches(closed):
    rng = np.random.default_rng(3)
    y, u, since = np.full(2000, 20.0), np.zeros(2000), 0
    for k in range(1999):
        on = u[k - 1]
        if closed:
            u[k] = float(y[k] < 40 + (0.5 if on else -0.5) + (k > 1000) * 5)
        else:
            since = int(rng.integers(15, 70)) if since == 0 else since - 1
            u[k] = 1 - on if since == 0 else on
        y[k + 1] = y[k] + 0.01 * (20 + 50 * u[k] - y[k]) + 0.01 * rng.standard_normal()
    log = make_log(np.arange(2000.0), {"q": (u, "1", "input"), "t": (y, "degC", "output")})
    found = one([log], "feedback")
    assert (found.verdict, "closed loop" in found.says) == (("warn", True) if closed else ("ok", False))


@pytest.mark.parametrize(("closed", "said"), [(True, "warn"), (False, "ok")])
def test_a_controller_that_switches_a_relay_for_a_share_of_each_window_is_found(closed, said):
    rng = np.random.default_rng(0)
    y, u, share, integral = np.full(4000, 20.0), np.zeros(4000), 0.3, 0.0
    for k in range(3999):
        if k % 20 == 0 and closed:
            miss = 35 + 10 * (k // 1000 % 2) - y[k]
            integral = np.clip(integral + 0.01 * miss, 0, 1)
            share = np.clip(0.1 * miss + integral, 0, 1)
        elif k % (20 * rng.integers(4, 12)) == 0 and not closed:
            share = rng.uniform()
        u[k] = k % 20 < round(20 * share)
        y[k + 1] = y[k] + 0.005 * (20 + 60 * u[k] - y[k]) + 0.01 * rng.standard_normal()
    log = make_log(np.arange(4000.0), {"q": (u, "1", "input"), "t": (np.round(y, 2), "degC", "output")})
    assert [finding.verdict for finding in check_data([log]).of("feedback")] == [said]


def test_open_loop_logs_are_not_accused_of_feedback():
    accused = sum(one([plant_log(seed=s)], "feedback").verdict == "warn" for s in range(20))
    assert accused == 0  # the test asks for p < 1e-4: 20 logs give 0.002 false alarms


def test_levels_that_are_held_in_open_loop_are_not_accused_of_feedback():
    # the output settles under each level and so shows when the next one is due
    for seed in range(4):
        rng = np.random.default_rng(seed)
        u = np.repeat(rng.choice([0.0, 0.3, 0.6], 60), 60)
        y = 23 + lfilter([0, 1 / 300], [1, -np.exp(-1 / 300)], u) * 40 + 0.05 * rng.standard_normal(u.size)
        log = make_log(np.arange(float(u.size)), {"q": (u, "1", "input"), "t": (y, "degC", "output")})
        (found,) = check_data([log], average=6.0).of("feedback")
        assert found.verdict == "ok"


def test_a_smooth_input_in_open_loop_is_not_accused_of_feedback():
    t = np.arange(1000)
    phases = np.random.default_rng(0).uniform(0, 2 * np.pi, 12)
    u = np.sum([np.sin(2 * np.pi * k * t / 400 + phase) for k, phase in enumerate(phases, 1)], axis=0)
    noisy = u + 1e-3 * np.random.default_rng(1).standard_normal(1000)
    assert one([plant_log(1000, q=noisy, noise=0.0)], "feedback").verdict == "ok"


# ---- each finding, number and words ----

K = np.arange(200)
ODD = (-1.0) ** K  # third differences of +-8, second of +-4
RISES = np.minimum(K, 100.0)


def lost(y, n):
    return np.where(n > K, np.nan, y)


def jumps(n, largest):
    """An output with n jumps; one is ``largest`` times as large as the others, which are of 2 K."""
    steps = np.zeros(200)
    steps[10 : 10 + 7 * n : 7] = 2.0
    steps[10] *= largest
    return steps.cumsum()


def found_in(y, check, *, q=ODD, time=K, average=1.0, channel="t", unit="1"):
    log = make_log(np.asarray(time, dtype=float), {"q": (q, unit, "input"), "t": (y, "degC", "output")})
    (found,) = (f for f in check_data([log], average=average).of(check) if f.channel == channel)
    return found.value, found.unit, found.verdict, found.says


RUNS_AWAY = ": time stamps are uncertain, fast dynamics cannot be trusted"
COARSE = ": coarse, equation-error fits are unreliable at the log's own rate"
LEAVE = " Leave it out with --outputs"
COMPUTED = "t has no noise: is it computed or smoothed, no reading?" + LEAVE
NOISE = 8 / 0.6745 / np.sqrt(20)  # of ODD


@pytest.mark.parametrize(
    ("check", "y", "value", "verdict", "says"),
    [
        ("lost", lost(ODD, 3), 0.015, "ok", "1.5 % of t is lost"),
        ("lost", lost(ODD, 4), 0.02, "warn", "2 % of t is lost: fits leave these rows out"),
        ("lost", lost(ODD, 59), 0.295, "warn", "30 % of t is lost: fits leave these rows out"),
        ("lost", lost(ODD, 60), 0.3, "fail", "30 % of t is lost: fits leave these rows out"),
        ("noise", lost(ODD, 151), 0.0, "ok", "t: too few readings to see noise"),
        ("noise", lost(ODD, 150), NOISE, "ok", "t has noise of 2.7 degC"),
        ("noise", jumps(9, 1.5), 0.0, "ok", "t has noise of 0 degC"),
        ("noise", jumps(9, 1.6), 0.0, "warn",
         "t is constant but for 9 jumps in 200 rows: is it a set point?" + LEAVE),
        ("noise", jumps(9, -1.6), 0.0, "warn",
         "t is constant but for 9 jumps in 200 rows: is it a set point?" + LEAVE),
        ("noise", jumps(10, 1.6), 0.0, "ok", "t has noise of 0 degC"),
        ("noise", RISES, 0.0, "ok", "t has noise of 0 degC"),  # 100 moves in 200 rows
        ("noise", np.minimum(K, 101.0), 0.0, "warn", COMPUTED),
        ("noise", K + 5e-5 * ODD, 5e-5 * NOISE, "warn", COMPUTED),  # 1.3e-4 K of 199 K, then 2.7e-4 K
        ("noise", K + 1e-4 * ODD, 1e-4 * NOISE, "ok", "t has noise of 0.00027 degC"),
        ("quantum", 0.25 * (K % 68), 0.25, "warn", "t moves in steps of 0.25 degC" + COARSE),  # sd 4.9 K
        ("quantum", 0.25 * (K % 83), 0.25, "ok", "t moves in steps of 0.25 degC"),  # sd 5.9 K
        ("quantum", np.sin(K), 0.0, "ok", "t shows no quantisation"),
    ],
)  # fmt: skip
def test_an_output_is_described_in_numbers_and_words(check, y, value, verdict, says):
    found = found_in(y, check)
    assert found[0] == pytest.approx(value, rel=1e-9, abs=1e-12)
    assert found[2:] == (verdict, says)
    assert found[1] == ("1" if check == "lost" else "degC")


def test_a_step_of_the_fits_beyond_one_and_a_half_rows_is_reported_with_the_quantum():
    for average, says in ((1.5, ""), (2.0, "; averaged over 2 s before the fits")):
        got = found_in(0.25 * (K % 68), "quantum", average=average)[3]
        assert got == "t moves in steps of 0.25 degC" + says + COARSE


def test_an_output_that_rests_in_one_log_has_no_noise_there():
    logs = [make_log(1.0 * K, {"q": (ODD, "1", "input"), "t": (y, "degC", "output")}) for y in (0 * ODD, ODD)]
    says = [f.says for f in check_data(logs, average=1.0).of("noise")]
    assert says == ["t: too few readings to see noise", "t has noise of 2.7 degC"]


@pytest.mark.parametrize(
    ("steps", "jitter", "verdict", "gap"),
    [
        (np.append(np.tile([0.81, 1.19], 99), 1.0), 0.19, "ok", None),
        (np.append(np.tile([0.79, 1.21], 99), 1.0), 0.21, "warn", None),
        (np.where(K[1:] == 50, 3.0, 1.0), 0.0, "ok", None),  # a row that fails is no jitter
        (np.where(K[1:] == 50, 61.0, np.where(K[1:] == 90, 12.0, 1.0)), 0.0, "ok", (2, 61)),
    ],
)
def test_times_are_described_in_numbers_and_words(steps, jitter, verdict, gap):
    time = np.append(0.0, np.cumsum(steps))
    got = found_in(ODD, "jitter", time=time, average=2.0, channel="time")
    assert got[0] == pytest.approx(jitter, abs=1e-3)
    says = f"rows are 1 s apart, within {100 * got[0]:.1f} %"
    assert got[1:] == ("1", verdict, says + (RUNS_AWAY if verdict == "warn" else ""))
    said = (0.0, "s", "ok", "no gap longer than 10 s")
    if gap:
        says = f"{gap[0]} gap(s), the longest {gap[1]} s: the input is unknown there"
        said = (float(gap[1]), "s", "warn", says)
    assert found_in(ODD, "gaps", time=time, average=2.0, channel="time") == said


def moved(n):
    return 0.3 + np.cumsum(np.isin(K, 20 * np.arange(1, n + 1))) % 2


LITTLE = ": too little for more than a gain"
QUARTER = np.array([0.0, 1.0, 0.0, -1.0])[K % 4]  # a sine of 4 rows, of two orders


@pytest.mark.parametrize(
    ("q", "value", "verdict", "says"),
    [
        (moved(3), 6.0, "warn", "q moves 3 times and excites 6 of 6 orders" + LITTLE),
        (moved(4), 6.0, "ok", "q moves 4 times and excites 6 of 6 orders"),
        (QUARTER, 2.0, "warn", "q moves 199 times and excites 2 of 6 orders" + LITTLE),
        (ODD + QUARTER, 3.0, "ok", "q moves 199 times and excites 3 of 6 orders"),
        # its rows have b^2 / 4 of the largest value of the covariance
        (ODD + 2.2e-3 * QUARTER, 3.0, "ok", "q moves 199 times and excites 3 of 6 orders"),
        (ODD + 1.8e-3 * QUARTER, 1.0, "warn",
         "q moves 199 times and excites 1 of 6 orders" + LITTLE),
        (1000 + 0.9e-6 * (K > 99), 0.0, "fail", "q never moves: nothing can be learnt about it"),
        (1000 + 1.1e-6 * (K > 99), 6.0, "warn",
         "q moves 1 times and excites 6 of 6 orders" + LITTLE),
        # on or off, and alone: a drive
        (0.0 * K, 0.0, "fail", "q never moves: nothing can be learnt about it"),
        ((K > 99) * 1.0, 6.0, "warn", "q moves 1 times and excites 6 of 6 orders" + LITTLE),
    ],
)  # fmt: skip
def test_the_excitation_of_an_input_is_counted(q, value, verdict, says):
    assert found_in(K / 10, "excitation", q=q, channel="q") == (value, "orders", verdict, says)


@pytest.mark.parametrize(
    ("pump", "value", "verdict", "says"),
    [
        (0.0 * K, 0.0, "warn", "pump never moves: nothing can be learnt about it"),
        ((K > 99) * 1.0, 6.0, "ok", "pump moves 1 times and excites 6 of 6 orders"),
    ],
)
def test_a_switch_beside_a_drive_may_rest_or_move_once(pump, value, verdict, says):
    inputs = {name: (u, "1", "input") for name, u in (("q", moved(4)), ("pump", pump))}
    log = make_log(1.0 * K, inputs | {"t": (K / 10, "degC", "output")})
    (found,) = (f for f in check_data([log], average=1.0).of("excitation") if f.channel == "pump")
    assert (found.value, found.unit, found.verdict, found.says) == (value, "orders", verdict, says)


@pytest.mark.parametrize(
    ("condition", "verdict", "says"),
    [
        (9e3, "ok", "inputs move apart"),
        (1.5e4, "fail", "p and q move together: their effects cannot be separated"),
    ],
)
def test_the_condition_of_two_inputs_is_that_of_their_correlation(condition, verdict, says):
    """With r = cos(a) it is (1 + r) / (1 - r) = cot(a / 2)^2; one that rests does not count."""
    other = 5.0 + 3 * (ODD + np.tan(2 * np.arctan(condition**-0.5)) * np.array([1, 1, -1, -1])[K % 4])
    more = {name: (v, "V", "input") for name, v in (("p", other), ("still", 0 * K + 1e10), ("q", ODD))}
    log = make_log(1.0 * K, more | {"t": (K / 10, "degC", "output")})
    (found,) = (f for f in check_data([log], average=1.0).of("excitation") if f.channel == "all inputs")
    assert found.value == pytest.approx(condition, rel=1e-4)
    assert (found.unit, found.verdict, found.says) == ("1", verdict, says)


def driven(n, by, seed=0, own=1.0):
    """A log whose input is noise and ``by`` times the reading of its row, which is noise as well."""
    y, noise = np.random.default_rng(seed).standard_normal((2, n))
    q = own * noise + by * y
    return make_log(np.arange(float(n)), {"q": (q, "V", "input"), "t": (y, "degC", "output")})


@pytest.mark.parametrize(
    ("n", "by", "share", "verdict"),
    [
        (4000, 1.0, 0.5, "warn"),  # by^2 / (1 + by^2) of its moves
        (4000, -0.5, 0.2, "warn"),
        (4000, 0.18, 0.0314, "warn"),
        (4000, 0.11, 0.012, "ok"),  # beyond doubt, but next to nothing
        (110, 0.3, 0.0826, "ok"),  # may be chance
    ],
)
def test_the_share_of_an_inputs_moves_that_the_readings_explain(n, by, share, verdict):
    found = one([driven(n, by)], "feedback")
    assert found.value == pytest.approx(share, abs=0.01 if n == 4000 else 0.16)
    assert found.verdict == verdict
    says = (
        f"q follows the outputs ({100 * found.value:.0f} % of its moves): recorded in closed loop; noise is "
    )
    says += "in the input too, so trust simulation-error fits and not one-step fits"
    assert found.says == (says if verdict == "warn" else "no sign that q was driven by the outputs")


@pytest.mark.parametrize("average", [1.0, 1.5, 1.6])
def test_means_over_rows_have_seen_what_the_input_did(average):
    """Means of both over the same seconds: only those of the rows before may show who follows whom."""
    log = driven(3000, 1.0)
    (found,) = check_data([log], average=average).of("feedback")
    assert (found.verdict == "warn") is (average < 1.6)


@pytest.mark.parametrize(("moves", "tested"), [(29, False), (30, True)])
def test_feedback_needs_three_moves_a_coefficient(moves, tested):
    """Six rows of its own past, which levels of four rows ask for, three of the output's and a constant."""
    q = np.random.default_rng(0).random(moves + 1)[np.minimum(np.maximum(np.arange(250) - 60, 0) // 4, moves)]
    y = np.random.default_rng(1).standard_normal(250)
    value, _, verdict, says = found_in(y, "feedback", q=q, time=np.arange(250), channel="q")
    assert (verdict, np.isfinite(value)) == ("ok", tested)
    words = (
        "no sign that q was driven by the outputs"
        if tested
        else "q moves too seldom to be tested for feedback"
    )
    assert says == words


def test_a_log_without_48_rows_before_one_is_not_tested_for_feedback():
    for n, finite in ((48, False), (100, True)):
        assert np.isfinite(check_data([driven(n, 1.0)], average=1.0).of("feedback")[0].value) == finite
    both = check_data([driven(48, 1.0), driven(100, 1.0)], average=1.0).of("feedback")[0]
    assert both.value == check_data([driven(100, 1.0)], average=1.0).of("feedback")[0].value


@pytest.mark.parametrize(
    ("steps", "y", "seconds", "excess"),
    [
        (1.0, 0.3 * ODD, 4.0, 0.3 * np.sqrt(0.75 * 16 / 6)),  # second differences of 4, one row in 4 s
        (2.0, 0.3 * ODD, 4.0, 0.3 * np.sqrt(0.5 * 16 / 6)),
        (1.0, 0.3 * ODD, 0.5, 0.0),
        (np.where(K[1:] == 90, 1.5, 1.0), 0.3 * ODD + 50 * (K > 89), 4.0, 0.3 * np.sqrt(2)),  # across a gap
        (np.where(K[1:] == 90, 1.4, 1.0), K + 9.0 * (K > 89), 4.0, np.sqrt(0.75 * 2 * 81 / 198 / 6)),
        (1.0, np.where(K == 9, np.nan, 0.3 * ODD), 4.0, 0.3 * np.sqrt(2)),
        (1.0, np.where(K % 2 == 1, np.nan, 0.3), 4.0, 0.0),
    ],
)
def test_the_noise_of_a_reading_off_its_bins_mean(steps, y, seconds, excess):
    time = np.append(0.0, np.cumsum(np.broadcast_to(steps, 199)))
    log = make_log(time, {"q": (ODD, "1", "input"), "t": (y, "degC", "output")})
    rows = rows_of(log, ("q",), ("t",), ())
    assert reading_excess([rows], ["t"], seconds) == {"t": pytest.approx(excess)}
    two = rows_of(log.assign(t2=2 * log["t"]), (), ("t", "t2"), ())
    assert reading_excess([two], ["t", "t2"], seconds)["t2"] == pytest.approx(2 * excess)
    slow = make_log(4.0 * K, {"q": (ODD, "1", "input"), "t": (K, "degC", "output")})
    if np.isfinite(y).all():  # rows of 4 s are means of themselves
        both = [rows, rows_of(slow, (), ("t",), ())]
        assert reading_excess(both, ["t"], seconds)["t"] < max(0.8 * excess, 1e-9)


# ---- what a plant rests on ----


@pytest.mark.parametrize(
    ("drive", "pump", "minutes", "thin"),
    [
        # rows of 6 s, 0.1 min each; the rows of a drive within 5 % of the largest are of neither kind
        ([(100, 1.0), (100, -2.0), (200, 0.1), (100, 0.11)], 0.5, (20.0, 10.0, 0.0), ["drive none"]),
        ([(100, 2.0), (100, -0.1), (300, -0.11)], 0.6, (10.0, 30.0, 50.0), []),
        ([(75, 1.0), (425, -1.0)], 0.0, (7.5, 42.5, 0.0), []),  # 15 % of 50 min
        ([(74, 1.0), (426, -1.0)], 0.0, (7.4, 42.6, 0.0), ["drive > 0"]),
        ([(149, 1.0), (2000, -1.0)], 1.0, (14.9, 200.0, 214.9), ["drive > 0"]),
        ([(150, 1.0), (2000, -1.0)], 1.0, (15.0, 200.0, 215.0), []),
    ],
)
def test_the_minutes_of_a_drive_to_either_side_are_counted(drive, pump, minutes, thin):
    plant = prior_plant(load_network("gripper"))
    value = np.concatenate([np.full(n, v) for n, v in drive])
    signals = {"drive": (value, plant.units["drive"], "input"), "pump": (0 * value + pump, "1", "input")}
    signals |= dict.fromkeys(plant.disturbances, (20 + 0 * value, "degC", "disturbance"))
    signals |= {name: (np.sin(np.arange(value.size)), "degC", "output") for name in plant.outputs}
    seen = covered(plant, [make_log(6.0 * np.arange(value.size), signals)])
    got = [seen.minutes[kind] for kind in ("drive > 0", "drive < 0", "pump on")]
    assert got == pytest.approx(minutes)
    assert seen.total == pytest.approx(value.size / 10) == pytest.approx(seen.minutes["pump off"] + got[2])
    assert [kind for kind in seen.thin if "pump" not in kind] == [t for t in thin if "none" not in t]
    never = "pump off" if pump > 0.5 else "pump on"
    assert seen.sentence(plant.units).endswith(f"{never} never occurs")


def test_a_row_stands_for_ten_seconds_or_five_rows_at_most_and_the_last_for_the_usual():
    plant = prior_plant(load_network("tclab"))
    for times, minutes in (
        ([0.0, 1.0, 2.0, 13.0], 13.0 / 60),
        ([0.0, 40.0, 80.0], 2.0),
        ([0.0, 4.0, 8.0, 30.0], 32.0 / 60),
    ):
        n = len(times)
        signals = {name: (np.linspace(0, 9, n), "percent", "input") for name in plant.inputs}
        signals |= {name: (np.linspace(0, 9, n), "degC", "output") for name in plant.outputs}
        assert covered(plant, [make_log(np.array(times), signals)]).total == pytest.approx(minutes)


@pytest.fixture
def gripper():
    return prior_plant(load_network("gripper"))


def test_a_pump_that_never_stops_is_reported(gripper):
    seen = covered(gripper, [load_example_logs()["step_up_down"]])
    assert "pump off" in seen.thin
    assert "pump off never occurs" in seen.sentence(gripper.units)
    both = covered(gripper, list(load_example_logs().values()))
    assert both.minutes["pump off"] > 5


def test_an_input_of_one_sign_is_described_by_its_halves():
    plant = prior_plant(load_network("tclab"))
    t = np.arange(0.0, 3600.0)
    signals = {
        "q1": (np.where(t < 60, 80.0, 20.0), "percent", "input"),
        "q2": (np.where(t < 1800, 80.0, 20.0), "percent", "input"),
        "t1": (t / 100, "degC", "output"),
        "t2": (t / 100, "degC", "output"),
    }
    seen = covered(plant, [make_log(t, signals | {"t2": (t / 50, "degC", "output")})])
    assert seen.thin == ("q1 above 50",)
    assert seen.ranges["t2"] == pytest.approx((0.72, 71.26), abs=0.01)
    assert seen.ranges["t1"] == pytest.approx((0.36, 35.63), abs=0.01)
    words = "The logs cover q1 between 20 and 80, q2 between 20 and 80, t1 between 0.36 and 35.6 degC, t2"
    assert words in seen.sentence({"t1": "degC", "t2": "1"})
    # no unit, no "1"
    assert seen.sentence({"t1": "degC", "t2": "1"}).split(";")[0].endswith("71.3 (98 % of the readings)")
