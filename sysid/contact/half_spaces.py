"""Heat exchange between the gripper skin and a grasped object, in closed form.

Both bodies are semi-infinite solids, joined by a thermal contact conductance h_c:

    skin (e_dev, T_dev0) | h_c | object (e_obj, T_obj0)

A flux q(t) into a half-space raises its surface by q(s) / (e sqrt(s)) in the Laplace domain, so closing the
loop q = h_c (T_obj_surf - T_dev_surf) gives, with H = h_c (1/e_dev + 1/e_obj) and y = H sqrt(t),

    q(t) = h_c (T_obj0 - T_dev0) erfcx(y),
    T_dev(0, t) = T_dev0 + (T_obj0 - T_dev0) / (1 + gamma) (1 - erfcx(y)),   gamma = e_dev / e_obj,
    T_dev(x, t) = T_dev0 + (T_obj0 - T_dev0) / (1 + gamma) exp(-xi^2) (erfcx(xi) - erfcx(xi + y)),

xi = x / (2 sqrt(alpha t)).  Perfect contact (h_c -> inf) is eq. (7) of Osawa et al. [1]_, who leave h_c out.

erfcx(x) = exp(x^2) erfc(x) neither over- nor underflows.  The differences above cancel for short times and
deep points; there they are taken as series or as integrals of positive terms, so that every result holds to
about 1e-12 of itself.  A block of thickness L is a half-space until heat has felt its back, at about L^2/(4
alpha): 0.9 s for 2 cm of copper, 18 min for 2 cm of wood; see :mod:`thermogrip.sysid.contact.finite_bodies`
for what comes after.

References
----------
.. [1] Osawa, Kase, Domae, Furukawa, Kheddar, "Material Classification Using Active Temperature Controllable
Robotic
   Gripper", arXiv:2111.15344.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import dawsn, erfcx, rgamma

__all__ = ["contact_flux", "contact_heat", "contact_temperature", "device_temperature"]
__all__ += ["object_surface_temperature", "object_temperature", "sensor_temperature", "skin_temperature"]

Array = NDArray[np.float64]

_LEGENDRE = np.polynomial.legendre.leggauss(40)


def contact_temperature(*, T_dev0: float, T_obj0: float, gamma: float) -> float:
    """Return the surface temperature at perfect contact [degC], eq. (7) of the paper.

    ``gamma`` is e_dev / e_obj; with T_dev0 = T_obj0 + dT0 it reads T_dev0 - dT0 / (1 + gamma), eq. (10).

    Raises
    ------
    ValueError
        If ``gamma`` is not positive.

    Examples
    --------
    >>> round(contact_temperature(T_dev0=23.0, T_obj0=43.0, gamma=1.6e3 / 3.64e4), 2)
    42.16
    """
    if not gamma > 0:
        raise ValueError(f"gamma must be positive, got {gamma:g}")
    return (T_obj0 + gamma * T_dev0) / (1 + gamma)


def skin_temperature(
    t: ArrayLike, *, T_dev0: float, T_obj0: float, e_dev: float, e_obj: float, h_c: float = np.inf
) -> Array:
    """Return the skin surface temperature after touching an object at t = 0.

    Parameters
    ----------
    t : (n_t,) array_like
        Time since contact [s], non-negative.
    T_dev0, T_obj0 : float
        Uniform temperatures just before contact [degC].
    e_dev, e_obj : float
        Thermal effusivities [W s^0.5 m^-2 K^-1], positive.
    h_c : float, optional
        Contact conductance [W m^-2 K^-1]. ``inf`` is perfect contact, as in the paper.

    Returns
    -------
    T_surf : (n_t,) ndarray
        Skin surface temperature [degC].

    Raises
    ------
    ValueError
        If a time is negative, or an effusivity or ``h_c`` is not positive.

    Examples
    --------
    >>> warm_block = dict(T_dev0=23.0, T_obj0=43.0, e_dev=1.6e3)
    >>> skin_temperature([1.0, 10.0], e_obj=3.64e4, h_c=500.0, **warm_block).round(1)
    array([28.4, 34.1])
    """
    t, y = _time_and_root(t, e_dev, e_obj, h_c)
    share = e_obj / (e_dev + e_obj)  # of the initial difference, at perfect contact
    return np.asarray(T_dev0 + (T_obj0 - T_dev0) * share * _drop(y))


def object_surface_temperature(
    t: ArrayLike, *, T_dev0: float, T_obj0: float, e_dev: float, e_obj: float, h_c: float = np.inf
) -> Array:
    """Return the object's surface temperature [degC]; parameters are those of :func:`skin_temperature`.

    Examples
    --------
    >>> warm_block = dict(T_dev0=23.0, T_obj0=43.0, e_dev=1.6e3)
    >>> object_surface_temperature([10.0], e_obj=3.64e4, h_c=500.0, **warm_block).round(2)
    array([42.51])
    """
    return skin_temperature(t, T_dev0=T_obj0, T_obj0=T_dev0, e_dev=e_obj, e_obj=e_dev, h_c=h_c)


def device_temperature(
    t: ArrayLike, depth: ArrayLike, *, T_dev0: float, T_obj0: float, e_dev: float, e_obj: float,
    alpha_dev: float, h_c: float = np.inf,
) -> Array:  # fmt: skip
    """Return the temperature inside the gripper.

    Parameters
    ----------
    t : array_like
        Time since contact [s], non-negative.
    depth : array_like
        Distance from the contact [m], non-negative; broadcast against ``t``.
    T_dev0, T_obj0, e_dev, e_obj, h_c
        As in :func:`skin_temperature`.
    alpha_dev : float
        Thermal diffusivity of the gripper [m^2/s], positive.

    Returns
    -------
    T : ndarray of the broadcast shape [degC]

    Raises
    ------
    ValueError
        If a time or depth is negative, or a property is not positive.

    Examples
    --------
    >>> device_temperature(10.0, [0.0, 1e-3, 5e-3], T_dev0=23.0, T_obj0=43.0, e_dev=1.6e3, e_obj=3.64e4,
    ...                    alpha_dev=1.4e-7, h_c=500.0).round(2)
    array([34.13, 28.26, 23.02])
    """
    t, y = _time_and_root(t, e_dev, e_obj, h_c)
    depth = np.asarray(depth, dtype=float)
    if np.any(depth < 0) or not alpha_dev > 0:
        raise ValueError(
            f"need depth >= 0 and diffusivity > 0, got {depth.min():g} m and {alpha_dev:g} m^2/s"
        )
    t, y, depth = np.broadcast_arrays(t, y, depth)
    started = t > 0
    # a zero time has moved nothing, at whatever depth; xi = 1 only avoids a division by zero
    xi = np.where(started, depth / (2 * np.sqrt(alpha_dev * np.where(started, t, 1.0))), 1.0)
    share = e_obj / (e_dev + e_obj)
    rise = np.exp(-(xi**2)) * _difference(xi, y)
    at_once = (depth == 0) & np.isinf(y)
    return np.asarray(
        T_dev0 + (T_obj0 - T_dev0) * share * np.where(started | at_once, np.where(started, rise, 1.0), 0.0)
    )


def object_temperature(
    t: ArrayLike, depth: ArrayLike, *, T_dev0: float, T_obj0: float, e_dev: float, e_obj: float,
    alpha_obj: float, h_c: float = np.inf,
) -> Array:  # fmt: skip
    """Return the temperature inside the object [degC]; parameters as in :func:`device_temperature`.

    ``depth`` is the distance from the contact into the object [m].

    Examples
    --------
    >>> object_temperature([1.0, 10.0], 0.01, T_dev0=23.0, T_obj0=43.0, e_dev=1.6e3, e_obj=3.64e4,
    ...                    alpha_obj=1.125e-4).round(2)
    array([42.57, 42.3 ])
    """
    return device_temperature(
        t, depth, T_dev0=T_obj0, T_obj0=T_dev0, e_dev=e_obj, e_obj=e_dev, alpha_dev=alpha_obj, h_c=h_c
    )


def contact_flux(
    t: ArrayLike, *, T_dev0: float, T_obj0: float, e_dev: float, e_obj: float, h_c: float = np.inf
) -> Array:
    """Return the heat flux into the gripper [W/m^2]; parameters are those of :func:`skin_temperature`.

    At perfect contact it is the paper's eq. (12) per unit area, infinite at t = 0.

    Examples
    --------
    >>> contact_flux([0.0, 10.0], T_dev0=23.0, T_obj0=43.0, e_dev=1.6e3, e_obj=3.64e4, h_c=500.0).round(0)
    array([10000.,  4191.])
    """
    t, y = _time_and_root(t, e_dev, e_obj, h_c)
    if np.isinf(h_c):
        with np.errstate(divide="ignore"):
            return np.asarray((T_obj0 - T_dev0) / (1 / e_dev + 1 / e_obj) / np.sqrt(np.pi * t))
    return np.asarray(h_c * (T_obj0 - T_dev0) * erfcx(y))


def contact_heat(
    t: ArrayLike, *, T_dev0: float, T_obj0: float, e_dev: float, e_obj: float, h_c: float = np.inf
) -> Array:
    """Return the heat that the gripper has taken up [J/m^2]; parameters are those of
    :func:`skin_temperature`.

    The integral of the flux, h_c (T_obj0 - T_dev0) / H^2 (erfcx(y) - 1 + 2 y / sqrt(pi)).

    Examples
    --------
    >>> contact_heat([1.0, 10.0], T_dev0=23.0, T_obj0=43.0, e_dev=1.6e3, e_obj=3.64e4, h_c=500.0).round(0)
    array([ 7990., 54795.])
    """
    t, y = _time_and_root(t, e_dev, e_obj, h_c)
    series = 1 / (1 / e_dev + 1 / e_obj)
    if np.isinf(h_c):
        return np.asarray((T_obj0 - T_dev0) * series * 2 * np.sqrt(t / np.pi))
    return np.asarray((T_obj0 - T_dev0) * series**2 / h_c * _excess(y))


def sensor_temperature(
    t: ArrayLike, *, T_dev0: float, T_obj0: float, e_dev: float, e_obj: float, lag: float, h_c: float = np.inf
) -> Array:
    """Return what a sensor on the skin reads that follows with a first-order lag.

    With w = lag^-1/2 and H = h_c (1/e_dev + 1/e_obj) the rise over that at perfect contact is

        1 - [w^2 erfcx(H sqrt(t)) + H^2 exp(-t/lag) + H w (2/sqrt(pi)) D(sqrt(t/lag))] / (H^2 + w^2),

    D being Dawson's integral (partial fractions of H / (s (sqrt(s) + H) (1 + lag s))).

    Parameters
    ----------
    t, T_dev0, T_obj0, e_dev, e_obj, h_c
        As in :func:`skin_temperature`.
    lag : float
        Time constant of the sensor [s], positive.

    Raises
    ------
    ValueError
        If a time is negative, or a property or the lag is not positive.

    Examples
    --------
    >>> sensor_temperature([0.1, 10.0], T_dev0=23.0, T_obj0=43.0, e_dev=1.6e3, e_obj=3.64e4, lag=0.8,
    ...                    h_c=800.0).round(2)
    array([23.25, 36.24])
    """
    t, y = _time_and_root(t, e_dev, e_obj, h_c)
    if not lag > 0:
        raise ValueError(f"lag must be positive, got {lag:g} s")
    share = e_obj / (e_dev + e_obj)
    ratio = t / lag
    if np.isinf(h_c):
        return np.asarray(T_dev0 + (T_obj0 - T_dev0) * share * -np.expm1(-ratio))
    # u = w / H, so that neither a stiff nor a weak contact overflows
    u = 1 / (h_c * (1 / e_dev + 1 / e_obj) * np.sqrt(lag))
    mixed = u**2 * erfcx(y) + np.exp(-ratio) + u * 2 / np.sqrt(np.pi) * dawsn(np.sqrt(ratio))
    rise = 1 - mixed / (1 + u**2)
    early = (ratio < 1) & (y < 2)
    if np.any(early):
        # the closed form cancels early; with s = t v^2 the convolution is an integral of smooth positive
        # terms
        v, weight = 0.5 * (_LEGENDRE[0] + 1), 0.5 * _LEGENDRE[1]
        r, root = np.atleast_1d(ratio)[..., None], np.atleast_1d(y)[..., None]
        part = (2 * v * weight * r * np.exp(-r * (1 - v**2)) * _drop(root * v)).sum(axis=-1)
        rise = np.where(early, part.reshape(np.shape(rise)), rise)
    return np.asarray(T_dev0 + (T_obj0 - T_dev0) * share * rise)


def _time_and_root(t: ArrayLike, e_dev: float, e_obj: float, h_c: float) -> tuple[Array, Array]:
    """Return t and y = H sqrt(t), inf at perfect contact, after checking what a caller may get wrong."""
    t = np.asarray(t, dtype=float)
    if not np.all(t >= 0):
        raise ValueError(f"time since contact must be >= 0 s, got {t[~(t >= 0)].ravel()[0]:g} s")
    if not all(value > 0 for value in (e_dev, e_obj, h_c)):
        raise ValueError(f"need {e_dev=:g}, {e_obj=:g}, {h_c=:g} all > 0")
    if np.isinf(h_c):
        return t, np.full(t.shape, np.inf)
    return t, np.asarray(h_c * (1 / e_dev + 1 / e_obj) * np.sqrt(t))


def _series(y: Array, first: int) -> Array:
    """Return the terms of erfcx(y) = sum (-y)^n / Gamma(n/2 + 1) from ``first`` on, for y below 1/2."""
    n = np.arange(first, first + 40)
    return np.asarray(((-y[..., None]) ** n * rgamma(n / 2 + 1)).sum(axis=-1))


def _drop(y: ArrayLike) -> Array:
    """Return 1 - erfcx(y) without cancellation."""
    y = np.asarray(y, dtype=float)
    return np.where(y < 0.5, -_series(np.minimum(y, 0.5), 1), 1 - erfcx(y))


def _excess(y: ArrayLike) -> Array:
    """Return erfcx(y) - 1 + 2 y / sqrt(pi) without cancellation."""
    y = np.asarray(y, dtype=float)
    return np.where(y < 0.5, _series(np.minimum(y, 0.5), 2), erfcx(y) - 1 + 2 * y / np.sqrt(np.pi))


def _difference(xi: Array, y: Array) -> Array:
    """Return erfcx(xi) - erfcx(xi + y) without cancellation, for xi, y >= 0.

    erfcx(x) = (2/sqrt(pi)) int_0^inf exp(-u^2 - 2 x u) du, so the difference is the integral of the positive
    exp(-u^2 - 2 xi u) (1 - exp(-2 y u)).
    """
    plain = erfcx(xi) - erfcx(xi + y)
    close = y < 0.5 * (1 + xi)
    if not np.any(close):
        return np.asarray(plain)
    x, d = xi[close][:, None], y[close][:, None]
    total = np.zeros(x.shape[0])
    # the integrand lives on a scale 1/(1 + xi): two panels cover it to exp(-36) and beyond
    for low, high in ((0.0, 4.0), (4.0, 20.0)):
        u = (low + (high - low) * 0.5 * (_LEGENDRE[0] + 1)) / (1 + x)
        weight = _LEGENDRE[1] * 0.5 * (high - low) / (1 + x)
        total += (weight * np.exp(-(u**2) - 2 * x * u) * -np.expm1(-2 * d * u)).sum(axis=1)
    result = np.array(plain)
    result[close] = 2 / np.sqrt(np.pi) * total
    return result
