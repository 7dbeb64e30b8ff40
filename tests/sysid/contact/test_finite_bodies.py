"""Slabs, layers and blocks: against high-precision inversion, against each other, against their limits."""

from __future__ import annotations

import mpmath as mp
import numpy as np
import pytest

from thermogrip.sysid.contact.closed_forms import (
    block_contact_flux,
    block_skin_temperature,
    contact_flux,
    half_space,
    invert_laplace,
    layer_on,
    layered_temperature,
    skin_temperature,
    slab,
    slab_heat,
    slab_temperature,
    slab_temperature_convective,
    two_body_flux,
    two_body_temperatures,
)

COPPER, WATER, BLOCK = 3.64e4, 1.6e3, 68600.0
UNIT = {"T_dev0": 0.0, "T_obj0": 1.0}
ONE_LAYER = dict.fromkeys(("e_layer", "alpha_layer", "e_base", "alpha_base"), 1.0)


def exact(transform, t):
    with mp.workdps(40):
        return float(mp.invertlaplace(transform, mp.mpf(float(t)), method="talbot", degree=40))


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
