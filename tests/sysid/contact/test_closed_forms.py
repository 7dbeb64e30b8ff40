"""Closed forms of contact: limits of the paper, high-precision inversion, finite volumes, what is refused."""

from __future__ import annotations

import mpmath as mp
import numpy as np
import pytest
from scipy.special import erf

from thermogrip.sysid.contact.closed_forms import (
    block_contact_flux,
    block_skin_temperature,
    contact_flux,
    contact_heat,
    contact_temperature,
    device_temperature,
    half_space,
    invert_laplace,
    layer_on,
    layered_temperature,
    object_surface_temperature,
    object_temperature,
    sensor_temperature,
    skin_temperature,
    slab,
    slab_heat,
    slab_temperature,
    slab_temperature_convective,
    two_body_flux,
    two_body_temperatures,
)

COPPER, WATER, BLOCK = 3.64e4, 1.6e3, 68600.0
T = np.geomspace(1e-3, 40.0, 9)
WARM, UNIT = {"T_dev0": 23.0, "T_obj0": 43.0}, {"T_dev0": 0.0, "T_obj0": 1.0}
ONE_LAYER = dict.fromkeys(("e_layer", "alpha_layer", "e_base", "alpha_base"), 1.0)


def exact(transform, t):
    """Invert a Laplace transform with forty digits: the independent solution."""
    with mp.workdps(40):
        return float(mp.invertlaplace(transform, mp.mpf(float(t)), method="talbot", degree=40))


def test_perfect_contact_is_eq_7_of_the_paper():
    gamma = WATER / COPPER
    T_s = (43.0 + 23.0 * gamma) / (1 + gamma)
    got = skin_temperature(T, e_dev=WATER, e_obj=COPPER, **WARM)
    np.testing.assert_allclose(got, np.full(T.shape, T_s), rtol=1e-12, strict=True)
    assert contact_temperature(gamma=gamma, **WARM) == pytest.approx(T_s, rel=1e-14)


def test_perfect_contact_flux_is_eq_12_of_the_paper():
    # Q/A = lambda (T_s - T_devi) / sqrt(pi alpha t), into the device
    k, alpha = 0.6, (0.6 / WATER) ** 2
    T_s = contact_temperature(gamma=WATER / COPPER, **WARM)
    want = k * (T_s - 23.0) / np.sqrt(np.pi * alpha * T)
    np.testing.assert_allclose(contact_flux(T, e_dev=WATER, e_obj=COPPER, **WARM), want, rtol=1e-12)


def test_depth_profile_at_perfect_contact_is_eq_4_of_the_paper():
    alpha, x, t = 1.4e-7, np.linspace(0, 4e-3, 7), 5.0
    T_s = contact_temperature(gamma=WATER / COPPER, **WARM)
    want = T_s + (23.0 - T_s) * erf(x / (2 * np.sqrt(alpha * t)))
    got = device_temperature(t, x, e_dev=WATER, e_obj=COPPER, alpha_dev=alpha, **WARM)
    np.testing.assert_allclose(got, want, rtol=1e-12)


# ratios of effusivity far beyond any material, conductances and times far beyond any grasp
RATIOS = [1e-4, 1e-2, 1.0, 1e2, 1e4]
CASES = [
    (gamma, h, t) for gamma in RATIOS for h, t in ((1.0, 1e-6), (800.0, 1e-3), (800.0, 10.0), (1e5, 1e6))
]


@pytest.mark.parametrize(("gamma", "h_c", "t"), CASES)
def test_skin_flux_and_heat_agree_with_an_independent_inversion(gamma, h_c, t):
    e_dev, e_obj = 1e3, 1e3 / gamma

    def flux(s):
        return 1 / (s * (1 / mp.mpf(h_c) + 1 / (e_dev * mp.sqrt(s)) + 1 / (e_obj * mp.sqrt(s))))

    bodies = {"e_dev": e_dev, "e_obj": e_obj, "h_c": h_c, **UNIT}
    assert contact_flux([t], **bodies)[0] == pytest.approx(exact(flux, t), rel=1e-8)
    assert contact_heat([t], **bodies)[0] == pytest.approx(exact(lambda s: flux(s) / s, t), rel=1e-8)
    rise = exact(lambda s: flux(s) / (e_dev * mp.sqrt(s)), t)
    assert skin_temperature([t], **bodies)[0] == pytest.approx(rise, rel=1e-8)
    fall = object_surface_temperature([t], **(bodies | {"T_dev0": -1.0, "T_obj0": 0.0}))[0]
    assert -fall == pytest.approx(exact(lambda s: flux(s) / (e_obj * mp.sqrt(s)), t), rel=1e-8)


@pytest.mark.parametrize("gamma", RATIOS)
@pytest.mark.parametrize(("depth", "t"), [(1e-9, 10.0), (1e-4, 0.1), (1e-3, 1.0), (2e-3, 1e4), (4e-3, 2.0)])
def test_temperature_at_depth_agrees_with_an_independent_inversion(gamma, depth, t):
    e_dev, e_obj, alpha, h_c = 1e3, 1e3 / gamma, 1.4e-7, 300.0

    def rise(s):
        root = mp.sqrt(s)
        flux = 1 / (s * (1 / mp.mpf(h_c) + 1 / (e_dev * root) + 1 / (e_obj * root)))
        return flux / (e_dev * root) * mp.exp(-root * mp.mpf(depth) / mp.sqrt(mp.mpf(alpha)))

    bodies = {"e_dev": e_dev, "e_obj": e_obj, "h_c": h_c, **UNIT}
    got = device_temperature([t], depth, alpha_dev=alpha, **bodies)[0]
    assert got == pytest.approx(exact(rise, t), rel=1e-8)


@pytest.mark.parametrize("h_c", [1e-2, 300.0, 1e5])
@pytest.mark.parametrize("lag", [0.05, 0.8, 5.0])
@pytest.mark.parametrize("t", [1e-4, 0.3, 10.0, 1e3])
def test_lagging_sensor_agrees_with_an_independent_inversion(h_c, lag, t):
    def reading(s):
        flux = 1 / (s * (1 / mp.mpf(h_c) + (1 / mp.mpf(WATER) + 1 / mp.mpf(COPPER)) / mp.sqrt(s)))
        return flux / (WATER * mp.sqrt(s)) / (1 + mp.mpf(lag) * s)

    got = sensor_temperature([t], T_dev0=0.0, T_obj0=1.0, e_dev=WATER, e_obj=COPPER, h_c=h_c, lag=lag)[0]
    assert got == pytest.approx(exact(reading, t), rel=1e-8, abs=0)


def test_both_bodies_agree_with_a_finite_volume_solution():
    """Crank-Nicolson on 2 x 400 cells: no formula in common with the closed form."""
    e_dev, e_obj, h_c, t_end, n = 1600.0, 4000.0, 700.0, 4.0, 400
    dz = 14.0 / n  # diffusion-time coordinate: seven diffusion lengths hold each body
    capacity = np.concatenate([np.full(n, e_dev * dz), np.full(n, e_obj * dz)])
    link = np.concatenate([np.full(n - 1, e_dev / dz), [0.0], np.full(n - 1, e_obj / dz)])
    link[n - 1] = 1 / (1 / h_c + dz / 2 / e_dev + dz / 2 / e_obj)
    rate = np.zeros((2 * n, 2 * n))
    for i, g in enumerate(link):
        rate[i, i] -= g
        rate[i + 1, i + 1] -= g
        rate[i, i + 1] += g
        rate[i + 1, i] += g
    rate /= capacity[:, None]
    steps = 800
    half = np.eye(2 * n) * 2 * steps / t_end
    move = np.linalg.solve(half - rate, half + rate)
    # the device's face is at cell n - 1, its depth grows downwards in index
    state = np.concatenate([np.full(n, 23.0), np.full(n, 43.0)])
    for _ in range(steps):
        state = move @ state
    depth = (np.arange(n) + 0.5) * dz
    bodies = {"e_dev": e_dev, "e_obj": e_obj, "h_c": h_c, **WARM}
    device = device_temperature(t_end, depth, alpha_dev=1.0, **bodies)
    block = object_temperature(t_end, depth, alpha_obj=1.0, **bodies)
    np.testing.assert_allclose(state[:n][::-1], device, atol=2e-3)
    np.testing.assert_allclose(state[n:], block, atol=2e-3)


def test_nothing_has_moved_at_time_zero():
    bodies = {"e_dev": WATER, "e_obj": COPPER, "h_c": 800.0, **WARM}
    assert skin_temperature([0.0], **bodies)[0] == 23.0
    inside = device_temperature(0.0, [0.0, 1e-3], alpha_dev=1e-7, **bodies)
    block = object_temperature(0.0, [0.0, 1e-3], alpha_obj=1e-7, **bodies)
    np.testing.assert_array_equal([inside, block], [[23.0, 23.0], [43.0, 43.0]])


@pytest.mark.parametrize(
    "bad", [{"t": [-1.0]}, {"t": [np.nan]}, {"e_dev": 0.0}, {"e_obj": -1.0}, {"h_c": 0.0}, {"h_c": np.nan}]
)
def test_what_no_contact_has_is_refused(bad):
    good = {"t": [1.0], "e_dev": WATER, "e_obj": COPPER, "h_c": 500.0, **WARM}
    with pytest.raises(ValueError, match=r"must be|need"):
        skin_temperature(**(good | bad))


@pytest.mark.parametrize("gamma", [1e-4, 1e-2, 1.0, 1e2, 1e4])
@pytest.mark.parametrize("t", [1e-4, 0.3, 10.0, 1e4])
def test_block_against_half_space_agrees_with_an_independent_inversion(gamma, t):
    e_dev, e_obj, capacity, h_c = 1e3, 1e3 / gamma, 5e3, 800.0

    def flux(s):
        root = mp.sqrt(s)
        block = mp.coth(root * mp.mpf(capacity) / mp.mpf(e_obj)) / (e_obj * root)
        return 1 / (s * (1 / mp.mpf(h_c) + 1 / (e_dev * root) + block))

    bodies = {"e_dev": e_dev, "e_obj": e_obj, "capacity": capacity, "h_c": h_c, **UNIT}
    assert block_contact_flux([t], **bodies)[0] == pytest.approx(exact(flux, t), rel=1e-8)
    rise = exact(lambda s: flux(s) / (e_dev * mp.sqrt(s)), t)
    assert block_skin_temperature([t], **bodies)[0] == pytest.approx(rise, rel=1e-8)


def test_a_block_is_a_half_space_until_heat_has_felt_its_back():
    t = np.array([0.01, 0.05, 0.1])  # the back of 2 cm of copper is felt at about 0.9 s
    bodies = {"e_dev": WATER, "e_obj": COPPER, "h_c": 800.0, **UNIT}
    np.testing.assert_allclose(
        block_contact_flux(t, capacity=BLOCK, **bodies), contact_flux(t, **bodies), rtol=1e-9
    )
    late = block_skin_temperature([100.0], capacity=BLOCK, **bodies)
    assert late[0] < skin_temperature([100.0], **bodies)[0] - 0.05


def test_a_thin_good_conductor_is_a_lump():
    """Its temperature follows C dT/dt = -h_c T against an infinite device: an exponential."""
    capacity, h_c = 1e3, 50.0
    t = np.array([1.0, 10.0, 60.0])
    _, block = two_body_temperatures(t, dev=half_space(1e9), obj=slab(1e7, capacity), h_c=h_c, **UNIT)
    np.testing.assert_allclose(block, np.exp(-h_c / capacity * t), rtol=1e-5)


@pytest.mark.parametrize("fo", [1e-4, 0.02, 0.149, 0.151, 1.0, 5.0])
@pytest.mark.parametrize("x", [0.0, 0.3, 1.0])
def test_slab_series_agree_with_an_independent_inversion(fo, x):
    thickness, alpha = 0.02, 1e-5
    t = fo * thickness**2 / alpha

    def held(s):
        q = mp.sqrt(s)
        return mp.cosh(q * (1 - x)) / (s * mp.cosh(q))

    got = slab_temperature([t], x * thickness, T0=0.0, T_surf=1.0, thickness=thickness, alpha=alpha)[0]
    assert got == pytest.approx(exact(held, fo), rel=1e-8, abs=1e-13)
    left = slab_temperature([t], x * thickness, T0=1.0, T_surf=0.0, thickness=thickness, alpha=alpha)[0]
    assert left == pytest.approx(1 - exact(held, fo), rel=1e-8, abs=1e-13)
    biot = 0.7

    def film(s):
        q = mp.sqrt(s)
        return mp.cosh(q * (1 - x)) / (s * (mp.cosh(q) + q / biot * mp.sinh(q)))

    got = slab_temperature_convective(
        [t], x * thickness, T0=0.0, T_fluid=1.0, h=biot * 50.0 / thickness, k=50.0, thickness=thickness,
        alpha=alpha,
    )[0]  # fmt: skip
    assert got == pytest.approx(exact(film, fo), rel=1e-8, abs=1e-13)


@pytest.mark.parametrize("fo", [1e-6, 0.01, 0.149, 0.151, 3.0])
def test_slab_heat_agrees_with_an_independent_inversion(fo):
    got = slab_heat([fo], T0=0.0, T_surf=1.0, capacity=1.0, effusivity=1.0)[0]
    assert got == pytest.approx(exact(lambda s: mp.tanh(mp.sqrt(s)) / s**1.5, fo), rel=1e-8)


@pytest.mark.parametrize(("e_layer", "e_base"), [(600.0, 1600.0), (1600.0, 600.0), (1e3, 10.0), (10.0, 1e4)])
@pytest.mark.parametrize("depth", [0.0, 5e-4, 1e-3, 3e-3])
def test_layered_body_agrees_with_an_independent_inversion(e_layer, e_base, depth):
    thickness, alpha_layer, alpha_base, t = 1e-3, 1e-7, 1.4e-7, 30.0

    def rise(s):
        q1, q2 = mp.sqrt(s / mp.mpf(alpha_layer)), mp.sqrt(s / mp.mpf(alpha_base))
        r = mp.mpf(e_layer - e_base) / mp.mpf(e_layer + e_base)
        fade = mp.exp(-2 * q1 * thickness)
        if depth <= thickness:
            shape = mp.exp(-q1 * depth) + r * fade * mp.exp(q1 * depth)
        else:
            shape = (1 + r) * mp.exp(-q1 * thickness - q2 * (depth - thickness))
        return shape / (s * (1 + r * fade))

    got = layered_temperature(
        [t], depth, T0=0.0, T_surf=1.0, thickness=thickness, e_layer=e_layer, alpha_layer=alpha_layer,
        e_base=e_base, alpha_base=alpha_base,
    )[0]  # fmt: skip
    assert got == pytest.approx(exact(rise, t), rel=1e-8)


@pytest.mark.parametrize(("t", "like", "rtol"), [(1e-4, 600.0, 1e-7), (1e5, WATER, 5e-3)])
def test_a_layered_device_starts_as_its_layer_and_ends_as_its_base(t, like, rtol):
    dev, of = layer_on(600.0, 300.0, half_space(WATER)), {"obj": half_space(COPPER), "h_c": 500.0, **UNIT}
    want = two_body_flux([t], dev=half_space(like), **of)
    np.testing.assert_allclose(two_body_flux([t], dev=dev, **of), want, rtol=rtol)


def test_inversion_error_falls_as_predicted():
    """exp(-1.358 n) until rounding: twelve points more gain at least six digits."""
    t, want = np.array([1e-3, 1.0, 1e5]), 1 / np.sqrt(np.pi * np.array([1e-3, 1.0, 1e5]))
    error = [np.abs(invert_laplace(lambda s: s**-0.5, t, n=n) / want - 1).max() for n in (8, 20)]
    assert error[1] < 1e-6 * error[0]
    assert np.abs(invert_laplace(lambda s: s**-0.5, t) / want - 1).max() < 1e-12


@pytest.mark.parametrize(
    "call",
    [
        lambda: device_temperature([1.0], -1e-3, alpha_dev=1e-7, e_dev=WATER, e_obj=COPPER, **WARM),
        lambda: sensor_temperature([1.0], lag=0.0, e_dev=WATER, e_obj=COPPER, **WARM),
        lambda: contact_temperature(gamma=0.0, **WARM),
        lambda: invert_laplace(lambda s: 1 / s, [0.0]),
        lambda: slab(0.0, 1.0),
        lambda: half_space(-1.0),
        lambda: slab_temperature([1.0], 0.03, T0=0, T_surf=1, thickness=0.02, alpha=1e-5),
        lambda: slab_temperature([-1.0], 0.0, T0=0, T_surf=1, thickness=0.02, alpha=1e-5),
        lambda: slab_heat([-1.0], T0=0, T_surf=1, capacity=1.0, effusivity=1.0),
        lambda: two_body_flux([1.0], dev=half_space(1.0), obj=half_space(1.0), h_c=0.0, **UNIT),
        lambda: layered_temperature([0.0], 0.0, T0=0, T_surf=1, thickness=1e-3, **ONE_LAYER),
    ],
)
def test_what_no_body_has_is_refused(call):
    with pytest.raises(ValueError, match=r"must|need|positive"):
        call()


def test_a_sensor_on_a_perfect_contact_follows_a_step():
    """The skin steps at once, so that the sensor relaxes to it; a stiff contact comes near."""
    of = {"e_dev": WATER, "e_obj": COPPER, "lag": 0.8, **WARM}
    t = np.array([0.0, 0.4, 3.0])
    want = 23.0 + 20.0 * COPPER / (WATER + COPPER) * (1 - np.exp(-t / 0.8))
    np.testing.assert_allclose(sensor_temperature(t, **of), want, rtol=1e-12)
    np.testing.assert_allclose(sensor_temperature(t, h_c=1e7, **of), want, atol=2e-3)


def test_heat_and_profiles_begin_at_nothing_and_end_in_balance():
    heat = slab_heat([0.0, 1e9], T0=23.0, T_surf=43.0, capacity=5e4, effusivity=1e4)
    np.testing.assert_allclose(heat, [0.0, 20.0 * 5e4])
    of = {"T0": 43.0, "thickness": 0.02, "alpha": 1e-5}
    np.testing.assert_allclose(slab_temperature([0.0, 1e9], 0.01, T_surf=23.0, **of), [43.0, 23.0])
    met = slab_temperature_convective([0.0, 1e9], [0.0, 0.02], T_fluid=23.0, h=500.0, k=70.0, **of)
    np.testing.assert_allclose(met, [43.0, 23.0])
    assert contact_heat([0.0], e_dev=WATER, e_obj=COPPER, h_c=800.0, **WARM)[0] == 0.0
    perfect = contact_heat([4.0], e_dev=WATER, e_obj=COPPER, **WARM)[0]  # twice the flux times the time
    assert perfect == pytest.approx(8.0 * contact_flux([4.0], e_dev=WATER, e_obj=COPPER, **WARM)[0])
