"""Plants small enough to reason about: a heater block, and a tank whose water reaches a skin late."""

from __future__ import annotations

import pytest

from tests.mpc.makers import make_tank
from thermogrip.mpc.native import runtime as build
from thermogrip.sysid.plant.plant import Plant


@pytest.fixture(scope="session")
def tank() -> Plant:
    return make_tank()


@pytest.fixture(scope="session")
def other_tank() -> Plant:
    """The truth that is not the model: 9 % less power, more loss, a slower skin, a longer tube."""
    return make_tank(heat=0.1, loss=1 / 600, skin=13.5, delay=9)


@pytest.fixture(scope="session")
def reversing_tank() -> Plant:
    """A tank whose cooling turns into heating beyond drive = -0.55."""
    return make_tank(heat=0.11, joule=0.1)


@pytest.fixture(scope="session")
def tank_maker():
    """The function that makes tanks."""
    return make_tank


@pytest.fixture(scope="session", autouse=True)
def _quick_builds():
    """Build C in a third of the time; the tests of whole commands build with the flags of users."""
    flags = tuple("-O1" if flag == "-O3" else flag for flag in build._GCC_FLAGS)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(build, "_GCC_FLAGS", flags)
        yield
