"""Helpers of the tests of the datasets room."""

from __future__ import annotations

import numpy as np
import pytest

from thermogrip.datasets.schema import make_grasps, make_log


@pytest.fixture
def small_log():
    """A short clean log with every role; its numbers need all their digits."""
    time = np.arange(40) * 0.1 + 1 / 3
    phase = np.arange(40) / 7
    t_surface = 25 + np.sin(phase)
    t_surface[5] = np.nan
    return make_log(
        time,
        {
            "drive": (np.sin(phase) / 3, "1", "input"),
            "pump": (np.ones(40), "1", "input"),
            "t_ambient": (21 + phase / 100, "degC", "disturbance"),
            "t_tank": (30 + np.cos(phase), "degC", "output"),
            "t_surface": (t_surface, "degC", "output"),
            "setpoint": (np.full(40, 30.1), "degC", "other"),
            "battery": (12 + phase / 1000, "V", "other"),
        },
        name="small",
        repairs=["one line", "and another"],
    )


@pytest.fixture
def small_grasps():
    """Six grasps of three materials, some facts unknown."""
    rng = np.random.default_rng(0)
    time = np.round(np.arange(-5, 11) * 0.1, 9)
    samples = 23 + np.cumsum(rng.random((6, 16)), axis=1)
    samples[2, 3] = np.nan
    return make_grasps(
        time,
        samples,
        [f"g{n}" for n in range(6)],
        name="small",
        t_surface_2=samples + 0.125,
        material=["copper", "copper", "wood", "wood", "zinc", ""],
        t_object=[43.0, 43.0, np.nan, 43.0, 43.0, 41.5],
        t_object_sd=[0.4] * 6,
        t_gripper=[23.0] * 6,
        t_ambient=[26.7, 27.0, 27.1, 27.0, 26.0, 26.0],
        experiment=["1-A"] * 6,
        split=["train", "test", "train", "test", "train", "test"],
        touch_group=["", "", "", "", "p1", "p1"],
        session=["monday"] * 6,
        block=["b1", "b1", "b2", "b2", "b3", "b4"],
        touch=[1, 1, 1, 1, 1, 2],
        rest=[np.nan, np.nan, np.nan, np.nan, np.nan, 60.0],
    )


@pytest.fixture
def write(tmp_path):
    """Write a text file and return its path."""

    def writer(text: str | bytes, name: str = "log.csv"):
        path = tmp_path / name
        path.write_bytes(text.encode() if isinstance(text, str) else text)
        return path

    return writer
