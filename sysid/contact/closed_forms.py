"""Heat exchange between the gripper skin and a grasped object, in closed form.

A negative time, a depth outside its body, or a property that is not positive is a ValueError everywhere.

**Half-spaces.**  Both bodies are semi-infinite solids, joined by a thermal contact conductance h_c:

    skin (e_dev, T_dev0) | h_c | object (e_obj, T_obj0)

A flux q(t) into a half-space raises its surface by q(s) / (e sqrt(s)) in the Laplace domain, so closing the
loop q = h_c (T_obj_surf - T_dev_surf) gives, with H = h_c (1/e_dev + 1/e_obj) and y = H sqrt(t),

    q(t) = h_c (T_obj0 - T_dev0) erfcx(y),
    T_dev(0, t) = T_dev0 + (T_obj0 - T_dev0) / (1 + gamma) (1 - erfcx(y)),   gamma = e_dev / e_obj.

**Slabs, layers, blocks.**  A body of finite depth answers a flux by its impedance, the rise of its face per
unit flux in the Laplace domain, and :func:`invert_laplace` gives fluxes and temperatures to 1e-11 of
themselves for any effusivity ratio, also where a surface or a fluid has a given temperature.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import erfcx, rgamma

from thermogrip.datasets.arrays import Array

Complex = NDArray[np.complex128]
Impedance = Callable[[Complex], Complex]

_LEGENDRE = np.polynomial.legendre.leggauss(40)


def contact_temperature(*, T_dev0: float, T_obj0: float, gamma: float) -> float:
    """Return the surface temperature at perfect contact [degC]; ``gamma`` is e_dev / e_obj.

    >>> round(contact_temperature(T_dev0=23.0, T_obj0=43.0, gamma=1.6e3 / 3.64e4), 2)
    42.16
    """
    _positive(gamma=gamma)
    # eq. (7) of Osawa, Kase, Domae, Furukawa, Kheddar, "Material Classification Using Active Temperature
    # Controllable Robotic Gripper", arXiv:2111.15344, who leave h_c out
    # with T_dev0 = T_obj0 + dT0 it reads T_dev0 - dT0 / (1 + gamma), eq. (10)
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
    # 1 - erfcx(y) without cancellation
    drop = np.where(y < 0.5, -_series(np.minimum(y, 0.5), 1), 1 - erfcx(y))
    return np.asarray(T_dev0 + (T_obj0 - T_dev0) * share * drop)


def object_surface_temperature(
    t: ArrayLike, *, T_dev0: float, T_obj0: float, e_dev: float, e_obj: float, h_c: float = np.inf
) -> Array:
    """Return the object's surface temperature [degC]; parameters are those of :func:`skin_temperature`.

    >>> warm_block = dict(T_dev0=23.0, T_obj0=43.0, e_dev=1.6e3)
    >>> object_surface_temperature([10.0], e_obj=3.64e4, h_c=500.0, **warm_block).round(2)
    array([42.51])
    """
    return skin_temperature(t, T_dev0=T_obj0, T_obj0=T_dev0, e_dev=e_obj, e_obj=e_dev, h_c=h_c)


def device_temperature(
    t: ArrayLike, depth: ArrayLike, *, T_dev0: float, T_obj0: float, e_dev: float, e_obj: float,
    alpha_dev: float, h_c: float = np.inf,
) -> Array:  # fmt: skip
    """Return the temperature [degC] inside the gripper at a ``depth`` from the contact [m], of the shape that
    it has with ``t``; ``alpha_dev`` is the gripper's diffusivity [m^2/s], all else as in
    :func:`skin_temperature`.

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
    # exp(-xi^2) (erfcx(xi) - erfcx(xi + y)), xi = x / (2 sqrt(alpha t))
    rise = np.exp(-(xi**2)) * _erfcx_difference(xi, y)
    at_once = (depth == 0) & np.isinf(y)
    return np.asarray(
        T_dev0 + (T_obj0 - T_dev0) * share * np.where(started | at_once, np.where(started, rise, 1.0), 0.0)
    )


def object_temperature(
    t: ArrayLike, depth: ArrayLike, *, T_dev0: float, T_obj0: float, e_dev: float, e_obj: float,
    alpha_obj: float, h_c: float = np.inf,
) -> Array:  # fmt: skip
    """Return the temperature inside the object [degC], at a ``depth`` from the contact into it [m]; all else
    as in :func:`device_temperature`.

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

    >>> contact_flux([0.0, 10.0], T_dev0=23.0, T_obj0=43.0, e_dev=1.6e3, e_obj=3.64e4, h_c=500.0).round(0)
    array([10000.,  4191.])
    """
    t, y = _time_and_root(t, e_dev, e_obj, h_c)
    if np.isinf(h_c):
        # eq. (12) of Osawa et al. per unit area, infinite at t = 0
        with np.errstate(divide="ignore"):
            return np.asarray((T_obj0 - T_dev0) / (1 / e_dev + 1 / e_obj) / np.sqrt(np.pi * t))
    return np.asarray(h_c * (T_obj0 - T_dev0) * erfcx(y))


def contact_heat(
    t: ArrayLike, *, T_dev0: float, T_obj0: float, e_dev: float, e_obj: float, h_c: float = np.inf
) -> Array:
    """Return the heat that the gripper has taken up [J/m^2]; parameters are those of
    :func:`skin_temperature`.

    >>> contact_heat([1.0, 10.0], T_dev0=23.0, T_obj0=43.0, e_dev=1.6e3, e_obj=3.64e4, h_c=500.0).round(0)
    array([ 7990., 54795.])
    """
    t, y = _time_and_root(t, e_dev, e_obj, h_c)
    series = 1 / (1 / e_dev + 1 / e_obj)
    if np.isinf(h_c):
        return np.asarray((T_obj0 - T_dev0) * series * 2 * np.sqrt(t / np.pi))
    # the integral of the flux, h_c (T_obj0 - T_dev0) / H^2 (erfcx(y) - 1 + 2 y / sqrt(pi)):
    # erfcx(y) - 1 + 2 y / sqrt(pi) without cancellation
    excess = np.where(y < 0.5, _series(np.minimum(y, 0.5), 2), erfcx(y) - 1 + 2 * y / np.sqrt(np.pi))
    return np.asarray((T_obj0 - T_dev0) * series**2 / h_c * excess)


def sensor_temperature(
    t: ArrayLike, *, T_dev0: float, T_obj0: float, e_dev: float, e_obj: float, lag: float, h_c: float = np.inf
) -> Array:
    """Return what a sensor on the skin reads [degC] that follows with a first-order ``lag`` [s]; all else as
    in :func:`skin_temperature`.

    >>> sensor_temperature([0.1, 10.0], T_dev0=23.0, T_obj0=43.0, e_dev=1.6e3, e_obj=3.64e4, lag=0.8,
    ...                    h_c=800.0).round(2)
    array([23.25, 36.24])
    """
    t, _ = _time_and_root(t, e_dev, e_obj, h_c)
    _positive(lag=lag)
    dev, obj = half_space(e_dev), half_space(e_obj)

    def transform(s: Complex) -> Complex:
        return dev(s) / (s * (1 / h_c + dev(s) + obj(s)) * (1 + lag * s))

    return T_dev0 + (T_obj0 - T_dev0) * _after_start(transform, t)


def invert_laplace(transform: Callable[[Complex], Complex], t: ArrayLike, *, n: int = 24) -> Array:
    """Return f(t) for a transform F(s) whose singularities lie on the negative real axis."""
    t = np.asarray(t, dtype=float)
    if not (np.all(t > 0) and np.all(np.isfinite(t))):
        raise ValueError("times of a Laplace inversion must be positive and finite")
    # f(t) is 1/(2 pi i) times the integral of F(s) exp(s t) along a path from below to above that leaves
    # every singularity of F on its left.  Transforms of conduction have theirs on the negative real axis
    # (poles of finite bodies, branch cuts of infinite ones), so the path may come in from minus infinity, as
    # Talbot's do.  On the cotangent contour s = (n / t) (-0.6122 + 0.5017 phi cot(0.6407 phi) + 0.2645 i phi)
    # with -pi < phi < pi the midpoint rule with n points converges as exp(-1.358 n); its constants make the
    # errors of discretisation and truncation fall together.  Rounding grows as exp(0.17 n), so n = 24 gives
    # 1e-13 in double precision, relative to the size of f around t: not of itself where f is exponentially
    # small, deep inside a body.  By conjugate symmetry the upper half is enough.
    phi = (2 * np.arange(n // 2) + 1) * np.pi / n
    cot = 1 / np.tan(0.6407 * phi)
    z = n * (-0.6122 + 0.5017 * phi * cot + 0.2645j * phi)
    dz = n * (0.5017 * (cot - 0.6407 * phi / np.sin(0.6407 * phi) ** 2) + 0.2645j)
    weight = np.exp(z) * dz
    s = z / t[..., None]
    # dz / dphi is 1/t of that in s; 1/(2 pi i) and the step 2 pi / n leave 2/n Im over the upper half
    return np.asarray((transform(s) * weight).imag.sum(axis=-1) * 2 / (n * t))


def half_space(effusivity: float) -> Impedance:
    """Return the impedance of a half-space, s -> 1 / (e sqrt(s)) [m^2 K W^-1].

    >>> complex(half_space(1600.0)(np.array(4.0 + 0j)))
    (0.0003125+0j)
    """
    _positive(effusivity=effusivity)
    # a block of thickness L is one until heat has felt its back, at about L^2 / (4 alpha): 0.9 s for 2 cm of
    # copper, 18 min for 2 cm of wood
    return lambda s: np.asarray(1 / (effusivity * np.sqrt(s)), dtype=complex)


def slab(effusivity: float, capacity: float) -> Impedance:
    """Return the impedance of a slab with an insulated back; ``capacity`` is C = rho c_p L [J m^-2 K^-1].

    >>> complex(slab(3.64e4, 68600.0)(np.array(1e-6 + 0j))).real.__round__(2)  # 1/(C s) when slow
    14.58
    """
    _positive(effusivity=effusivity, capacity=capacity)

    def impedance(s: Complex) -> Complex:
        root = np.sqrt(s)
        # Z = coth(sqrt(s) z) / (e sqrt(s)) with z = L / sqrt(alpha) = C / e
        fade = np.exp(-2 * root * capacity / effusivity)
        return np.asarray((1 + fade) / ((1 - fade) * effusivity * root))

    return impedance


def layer_on(effusivity: float, capacity: float, base: Impedance) -> Impedance:
    """Return the impedance of a layer of capacity C = rho c_p L [J m^-2 K^-1] in perfect contact with a base.

    >>> same = layer_on(900.0, 100.0, half_space(900.0))  # a layer of the base's own stuff changes nothing
    >>> bool(np.isclose(same(np.array(2.0 + 1j)), half_space(900.0)(np.array(2.0 + 1j)), rtol=1e-14))
    True
    """
    _positive(effusivity=effusivity, capacity=capacity)

    def impedance(s: Complex) -> Complex:
        # Z = (1/e) (Z2 e cosh + sinh / sqrt(s)) / (cosh + Z2 e sqrt(s) sinh), of sqrt(s) z, on a body Z2;
        # cosh and sinh over exp(sqrt(s) z), which would overflow
        surface_impedance = 1 / (effusivity * np.sqrt(s))
        fade = np.exp(-2 * np.sqrt(s) * capacity / effusivity)
        below = base(s)
        return np.asarray(
            surface_impedance
            * (below * (1 + fade) + surface_impedance * (1 - fade))
            / (surface_impedance * (1 + fade) + below * (1 - fade))
        )

    return impedance


def two_body_flux(
    t: ArrayLike, *, dev: Impedance, obj: Impedance, T_dev0: float, T_obj0: float, h_c: float = np.inf
) -> Array:
    """Return the heat flux into the gripper [W/m^2] at times t > 0 [s] for any two impedances.

    >>> two_body_flux([10.0], dev=half_space(1.6e3), obj=half_space(3.64e4), T_dev0=23.0, T_obj0=43.0,
    ...               h_c=500.0).round(0)
    array([4191.])
    """
    _positive(h_c=h_c)
    # the bodies meet through h_c: q(s) = dT/s / (1/h_c + Z_dev + Z_obj)
    return (T_obj0 - T_dev0) * invert_laplace(lambda s: 1 / (s * (1 / h_c + dev(s) + obj(s))), t)


def two_body_temperatures(
    t: ArrayLike, *, dev: Impedance, obj: Impedance, T_dev0: float, T_obj0: float, h_c: float = np.inf
) -> tuple[Array, Array]:
    """Return the surface temperatures of gripper and object [degC] at times t > 0 [s] for any two impedances.

    >>> bodies = dict(dev=half_space(1.6e3), obj=slab(3.64e4, 68600.0))
    >>> skin, block = two_body_temperatures([10.0], T_dev0=23.0, T_obj0=43.0, h_c=500.0, **bodies)
    >>> skin.round(2), block.round(2)
    (array([33.97]), array([42.14]))
    """
    _positive(h_c=h_c)

    def rise(of: Impedance) -> Array:
        return invert_laplace(lambda s: of(s) / (s * (1 / h_c + dev(s) + obj(s))), t)

    difference = T_obj0 - T_dev0
    return T_dev0 + difference * rise(dev), T_obj0 - difference * rise(obj)


def block_contact_flux(
    t: ArrayLike, *, T_dev0: float, T_obj0: float, e_dev: float, e_obj: float, capacity: float,
    h_c: float = np.inf,
) -> Array:  # fmt: skip
    """Return the flux into a half-space gripper from a block of C = rho c_p L with an insulated back [W/m^2].

    Times t > 0 [s]; effusivities [W s^0.5 m^-2 K^-1]; capacity [J m^-2 K^-1]; h_c [W m^-2 K^-1].

    >>> block_contact_flux([10.0], T_dev0=23.0, T_obj0=43.0, e_dev=1.6e3, e_obj=3.64e4, capacity=68600.0,
    ...                    h_c=500.0).round(0)
    array([4082.])
    """
    return two_body_flux(
        t, dev=half_space(e_dev), obj=slab(e_obj, capacity), T_dev0=T_dev0, T_obj0=T_obj0, h_c=h_c
    )


def block_skin_temperature(
    t: ArrayLike, *, T_dev0: float, T_obj0: float, e_dev: float, e_obj: float, capacity: float,
    h_c: float = np.inf,
) -> Array:  # fmt: skip
    """Return the skin temperature of a half-space gripper on a block [degC]; as :func:`block_contact_flux`.

    >>> block_skin_temperature([10.0], T_dev0=23.0, T_obj0=43.0, e_dev=1.6e3, e_obj=3.64e4, capacity=68600.0,
    ...                        h_c=500.0).round(2)
    array([33.97])
    """
    dev, obj = half_space(e_dev), slab(e_obj, capacity)
    return two_body_temperatures(t, dev=dev, obj=obj, T_dev0=T_dev0, T_obj0=T_obj0, h_c=h_c)[0]


def slab_temperature(
    t: ArrayLike, depth: ArrayLike, *, T0: float, T_surf: float, thickness: float, alpha: float
) -> Array:
    """Return the temperature [degC], first T0, at times t [s] and a ``depth`` from the face [m] in a slab of
    this ``thickness`` [m] and diffusivity ``alpha`` [m^2/s], whose face is held at ``T_surf`` from t = 0 and
    whose back is insulated.

    >>> slab_temperature([1.0, 100.0], 0.02, T0=43.0, T_surf=23.0, thickness=0.02, alpha=1.0e-5).round(3)
    array([43.   , 23.053])
    """
    fo, x = _fourier(t, depth, thickness, alpha)
    return T0 + (T_surf - T0) * _slab_rise(fo, x, np.inf)


def slab_heat(t: ArrayLike, *, T0: float, T_surf: float, capacity: float, effusivity: float) -> Array:
    """Return the heat that the slab of :func:`slab_temperature` has taken up [J/m^2], t >= 0 [s], where
    ``capacity`` is rho c_p L [J m^-2 K^-1].

    >>> slab_heat([1.0, 1e6], T0=23.0, T_surf=43.0, capacity=68600.0, effusivity=1.6e4).round(0)
    array([ 361081., 1372000.])
    """
    _positive(capacity=capacity, effusivity=effusivity)
    t = np.asarray(t, dtype=float)
    if not np.all(t >= 0):
        raise ValueError("time must be >= 0 s")
    fo = t * (effusivity / capacity) ** 2

    def transform(s: Complex) -> Complex:
        fade = np.exp(-2 * np.sqrt(s))
        return np.asarray((1 - fade) / (1 + fade) / s**1.5)

    return capacity * (T_surf - T0) * _after_start(transform, fo)


def slab_temperature_convective(
    t: ArrayLike, depth: ArrayLike, *, T0: float, T_fluid: float, h: float, k: float, thickness: float,
    alpha: float,
) -> Array:  # fmt: skip
    """Return the temperature [degC] in the slab of :func:`slab_temperature`, of conductivity ``k``
    [W m^-1 K^-1], where its face meets a fluid of ``T_fluid`` through a film conductance ``h``
    [W m^-2 K^-1].

    >>> slab_temperature_convective([1.0, 100.0], 0.0, T0=43.0, T_fluid=23.0, h=500.0, k=73.0, thickness=0.02,
    ...                             alpha=2.05e-5).round(2)
    array([42.32, 32.77])
    """
    _positive(h=h, k=k)
    fo, x = _fourier(t, depth, thickness, alpha)
    return T0 + (T_fluid - T0) * _slab_rise(fo, x, h * thickness / k)


def layered_temperature(
    t: ArrayLike, depth: ArrayLike, *, T0: float, T_surf: float, thickness: float, e_layer: float,
    alpha_layer: float, e_base: float, alpha_base: float,
) -> Array:  # fmt: skip
    """Return the temperature [degC], first T0, at times t > 0 [s] and a ``depth`` from the face [m] in a
    layer of this ``thickness`` [m] or the half-space below it, of these effusivities [W s^0.5 m^-2 K^-1] and
    diffusivities [m^2/s], whose face is held at ``T_surf`` from t = 0.

    >>> layered_temperature(5.0, [1e-3, 5e-3], T0=23.0, T_surf=43.0, thickness=1e-3, e_layer=600.0,
    ...                     alpha_layer=1e-7, e_base=1600.0, alpha_base=1.4e-7).round(2)
    array([26.47, 23.  ])
    """
    _positive(
        thickness=thickness, e_layer=e_layer, alpha_layer=alpha_layer, e_base=e_base, alpha_base=alpha_base
    )
    t, x = np.broadcast_arrays(np.asarray(t, dtype=float), np.asarray(depth, dtype=float))
    if not np.all(t > 0) or np.any(x < 0):
        raise ValueError("need t > 0 s and depth >= 0 m")
    r, z = (e_layer - e_base) / (e_layer + e_base), thickness / np.sqrt(alpha_layer)
    inside = np.minimum(x, thickness)[..., None] / np.sqrt(alpha_layer)
    below = np.maximum(x - thickness, 0.0)[..., None] / np.sqrt(alpha_base)

    def transform(s: Complex) -> Complex:  # reflected by r at the joint, by -1 at the face
        q = np.sqrt(s)
        rise = (np.exp(-q * inside) + r * np.exp(-q * (2 * z - inside))) * np.exp(-q * below)
        return np.asarray(rise / (s * (1 + r * np.exp(-2 * q * z))))

    return T0 + (T_surf - T0) * invert_laplace(transform, t)


def _time_and_root(t: ArrayLike, e_dev: float, e_obj: float, h_c: float) -> tuple[Array, Array]:
    """Return t and y = H sqrt(t), inf at perfect contact, after checking what a caller may get wrong."""
    t = np.asarray(t, dtype=float)
    if not np.all(t >= 0):
        raise ValueError(f"time since contact must be >= 0 s, got {t[~(t >= 0)].ravel()[0]:g} s")
    _positive(e_dev=e_dev, e_obj=e_obj, h_c=h_c)
    if np.isinf(h_c):
        return t, np.full(t.shape, np.inf)
    return t, np.asarray(h_c * (1 / e_dev + 1 / e_obj) * np.sqrt(t))


def _series(y: Array, first: int) -> Array:
    """Return the terms of erfcx(y) = sum (-y)^n / Gamma(n/2 + 1) from ``first`` on, for y below 1/2."""
    n = np.arange(first, first + 40)
    return np.asarray(((-y[..., None]) ** n * rgamma(n / 2 + 1)).sum(axis=-1))


def _erfcx_difference(xi: Array, y: Array) -> Array:
    """Return erfcx(xi) - erfcx(xi + y) without cancellation, for xi, y >= 0."""
    # erfcx(x) = exp(x^2) erfc(x) = (2/sqrt(pi)) int_0^inf exp(-u^2 - 2 x u) du neither over- nor underflows,
    # but this difference cancels for short times and deep points: there it is the integral of the positive
    # exp(-u^2 - 2 xi u) (1 - exp(-2 y u)), so that every result holds to about 1e-12 of itself
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


def _positive(**values: float) -> None:
    for name, value in values.items():
        if not value > 0:
            raise ValueError(f"{name} must be positive, got {value:g}")


def _fourier(t: ArrayLike, depth: ArrayLike, thickness: float, alpha: float) -> tuple[Array, Array]:
    _positive(thickness=thickness, alpha=alpha)
    fo, x = np.broadcast_arrays(
        np.asarray(t, float) * alpha / thickness**2, np.asarray(depth, float) / thickness
    )
    if not np.all(fo >= 0) or not np.all((x >= 0) & (x <= 1)):
        raise ValueError("need t >= 0 s and depth between 0 and the thickness")
    return np.array(fo), np.array(x)


def _slab_rise(fo: Array, x: Array, biot: float) -> Array:
    """Return the rise of a slab at depths x towards what its face meets, both 1 in the end."""
    depth_share = x[..., None]

    def transform(s: Complex) -> Complex:
        # cosh(q (1 - x)) / (s (cosh(q) + (q / Bi) sinh(q))), times in units of L^2 / alpha, q = sqrt(s);
        # Bi = h L / k, infinite at a held surface
        q, fade = np.sqrt(s), np.exp(-2 * np.sqrt(s))
        shape = np.exp(-q * depth_share) + np.exp(-q * (2 - depth_share))
        return np.asarray(shape / (s * ((1 + fade) + q / biot * (1 - fade))))

    return _after_start(transform, fo)


def _after_start(transform: Callable[[Complex], Complex], t: Array) -> Array:
    """Return f(t), 0 at t = 0."""
    return np.where(t > 0, invert_laplace(transform, np.where(t > 0, t, 1.0)), 0.0)
