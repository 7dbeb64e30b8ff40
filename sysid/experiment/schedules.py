"""Input schedules to identify a plant by: PRBS, multisine, staircase, inside the rig's limits.

To excite time constants from tau_fast to tau_slow periods should span about pi tau_fast to 2 pi tau_slow.
The first 6 s rest at the middle, so that the start is known.
"""

from __future__ import annotations

import numpy as np

from thermogrip.datasets.arrays import Array
from thermogrip.datasets.errors import UserError, known_names
from thermogrip.datasets.schema import Log, make_log

KINDS = ("prbs", "multisine", "staircase")

REST = 6.0  # [s] at the middle before anything moves


def excite(
    kind: str,
    minutes: float,
    *,
    dt: float = 0.5,
    low: float = -1.0,
    high: float = 1.0,
    tau_fast: float = 10.0,
    tau_slow: float = 200.0,
    seed: int = 0,
) -> Log:
    """Return a schedule as a Log with ``drive`` and a ``pump`` that runs, a row every dt.

    Parameters
    ----------
    kind : {"prbs", "multisine", "staircase"}
    minutes : float
        Length [min].
    dt : float, optional
        Time between rows [s].
    low, high : float, optional
        Limits of the drive, as a share of full scale.
    tau_fast, tau_slow : float, optional
        Time constants of the plant to excite [s].
    seed : int, optional
        Where the PRBS begins in its sequence, the phases of the multisine, the first way of the staircase.

    Raises
    ------
    UserError
        If the kind is unknown, the limits are empty, or the schedule is too short for the time constants.

    Examples
    --------
    >>> log = excite("prbs", 20.0)
    >>> sorted(set(log["drive"].values.tolist())), log.sizes["time"]
    ([-1.0, 0.0, 1.0], 2400)
    """
    if kind not in KINDS:
        raise UserError(f"no schedule of kind {kind!r}", hint=known_names(kind, KINDS))
    if not high > low:
        raise UserError(f"limits {low:g} to {high:g} are empty", hint="give low below high")
    if not (0 < tau_fast < tau_slow and dt > 0):
        raise UserError("need 0 < tau_fast < tau_slow and dt > 0")
    seconds = 60.0 * minutes
    if seconds < max(REST + 20 * tau_fast, 40 * dt):
        raise UserError(
            f"{minutes:g} min are too short for time constants from {tau_fast:g} s",
            hint=f"take {(REST + 20 * tau_fast) / 60:.1f} min or more",
        )
    time = dt * np.arange(round(seconds / dt))
    rest_rows = int(np.ceil(REST / dt))
    n = time.size - rest_rows
    if kind == "prbs":
        # 2^n - 1 bits of tau_fast have a spectrum flat up to 0.44 / tau_fast and are balanced but for one bit
        shape = prbs(n, hold=max(1, round(tau_fast / dt)), seed=seed)
    elif kind == "multisine":
        shape = multisine(n, slowest=2 * np.pi * tau_slow / dt, fastest=np.pi * tau_fast / dt, seed=seed)
    else:
        # shows the curvature that two-level signals cannot
        shape = staircase(n, hold=3 * tau_slow / dt, seed=seed)
    drive = (low + high) / 2 + (high - low) / 2 * np.concatenate([np.zeros(rest_rows), shape])
    columns = {"drive": (drive, "1", "input"), "pump": (np.ones(time.size), "1", "input")}
    return make_log(time, columns, name=f"{kind} schedule")


def prbs(n: int, *, hold: int, seed: int = 0) -> Array:
    """Return n samples of a maximum-length sequence of +-1, each bit held for ``hold`` samples, from as many
    register bits (3 to 10) as let one full period fit."""
    from scipy.signal import max_len_seq  # slow to import, and the other schedules do without

    bits = max(3, min(10, int(np.floor(np.log2(max(n / hold, 7) + 1)))))
    # begun with one bit alone, as all ones hold the drive for as many bits as there are
    register, _ = max_len_seq(bits, state=[0] * (bits - 1) + [1])
    sequence = np.where(register, 1.0, -1.0)
    # golden steps: whichever seeds several inputs have, they begin far apart and barely correlate
    begin = round(seed * 0.6180339887498949 * len(sequence)) % len(sequence)
    rows = np.repeat(np.roll(sequence, -begin), hold)
    return np.asarray(np.tile(rows, -(-n // rows.size))[:n])


def multisine(n: int, *, slowest: float, fastest: float, seed: int = 0) -> Array:
    """Return n samples of a multisine within +-1."""
    first, last = max(1, int(np.ceil(n / slowest))), max(2, int(n / max(fastest, 4.0)))
    # log-spaced whole harmonics of the record, all of one amplitude
    harmonics = np.unique(np.round(np.geomspace(first, max(first + 1, last), 25)).astype(int))
    k = np.arange(1, harmonics.size + 1)
    drawn = np.random.default_rng(seed).uniform(0, 2 * np.pi, (100, k.size))
    # of least crest factor among Schroeder's (for consecutive harmonics) and 100 random sets
    phases = np.vstack([-np.pi * k * (k - 1) / k.size, drawn])
    spectrum = np.zeros((len(phases), n // 2 + 1), dtype=complex)
    spectrum[:, harmonics] = np.exp(1j * phases)
    waves = np.fft.irfft(spectrum, n, axis=1)
    peaks = np.abs(waves).max(axis=1)
    best = int(np.argmin(peaks))
    return np.asarray(waves[best] / peaks[best])


def staircase(n: int, *, hold: float, seed: int = 0) -> Array:
    """Return n samples of stairs over +-1, up and down, of 3 to 9 levels."""
    stairs = int(np.clip(n / hold, 6, 18))
    half = max(1, round(stairs / 2 / 2))
    up = np.linspace(0.0, 1.0, half + 1)[1:]
    levels = np.concatenate([up, up[::-1][1:], [0.0], -up, -up[::-1][1:], [0.0]])
    return np.asarray((-1.0) ** (seed % 2) * levels[(np.arange(n) * levels.size) // n])
