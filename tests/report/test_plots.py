"""Figures: what each shows, units on every axis, legends that cover nothing."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.text import Text as MplText

from tests.end_to_end.conftest import HEADER, small_log_rows, small_plant
from tests.report.conftest import described
from thermogrip.datasets.log_files import read_log
from thermogrip.datasets.schema import make_grasps, make_log
from thermogrip.mpc import PIController, simulate_closed_loop
from thermogrip.report import plot
from thermogrip.report.charts import draw_chart
from thermogrip.report.plant import bode_chart, corner_figure, free_run_chart
from thermogrip.report.plots import grasps_chart, loops_chart, steps_chart
from thermogrip.sysid import free_run, identify
from thermogrip.sysid.export.dynamics import Estimate
from thermogrip.sysid.validation.stated_errors import Band


def waves(n: int, shift: float = 0.0) -> Any:
    """Return a log of n rows with two inputs and two outputs, the last third of it not scored."""
    t = 10.0 + np.arange(float(n))
    scored = (np.arange(n) < 2 * n / 3).astype(float)
    return make_log(
        t,
        {
            "q1": (10.0 * np.arange(n), "percent", "input"),
            "drive": (np.cos(t), "1", "input"),
            "t1": (20.0 + np.sin(t) + shift, "degC", "output"),
            "level": (3.0 + np.cos(t / 2) + shift, "V", "output"),
            "t2": (15.0 + np.sin(t / 3), "degC", "output"),
            "t3": (10.0 + np.sin(t / 4), "degC", "output"),
            "scored": (scored, "1", "other"),
        },
        name="waves",
    )


def free_run_of(n: int) -> Figure:
    band = Band({name: np.full(n, 0.5) for name in ("t1", "level")}, {"t1": 0.9, "level": 0.8}, 3)
    run: Any = SimpleNamespace(measured=waves(n), log=waves(n, 0.25), scores=dict.fromkeys(("t1", "level")))
    return draw_chart(free_run_chart(run, ("t1", "level"), band))


def corner_of() -> Figure:
    free = ("a", "b", "c", "d")
    rng = np.random.default_rng(0)
    samples = rng.standard_normal((200, 4)) + [0.0, 10.0, 20.0, 30.0]
    values = {name: 10.0 * k for k, name in enumerate(free)}
    plant: Any = SimpleNamespace(values=values, units={"a": "W/K", "c": "s"})
    record: Any = SimpleNamespace(sampled=("a", "c", "d"), free=free, samples=samples)
    return corner_figure(plant, record)


def loops_of() -> Figure:
    runs, targets = {"first": waves(6), "second": waves(7, 1.0)}, {"first": 30.0, "second": 35.0}
    return draw_chart(loops_chart(runs, targets, output="t1"))


def steps_of() -> Figure:
    time = np.arange(5.0)

    def loop(level: float) -> Any:
        out, drive = {"t": level + time}, {"u": level / 100 + time / 10}
        target = {"t": np.full(4, 38.0)}
        return SimpleNamespace(
            time=time, sample_time=time[:4], outputs=out, drive={"u": drive["u"][:4]}, target=target
        )

    runs = {"28 to 38, MPC": loop(37.0), "28 to 38, PI": loop(36.0), "28 to 18, PI": loop(18.0)}
    return draw_chart(steps_chart(runs))


def grasps_of(*labels: str) -> Any:
    traces = [[23.0 + k, 24.0 + 2 * k, 26.0] for k in range(2)]
    known = {"material": list(labels)} if labels else {}
    return make_grasps([-0.1, 0.1, 0.4], traces, ["a", "b"], name="unlabelled", **known)


FIGURES: dict[str, Callable[[], Figure]] = {
    "free run": lambda: free_run_of(12),
    "free run of many rows": lambda: free_run_of(3001),
    "corner": corner_of,
    "loops": loops_of,
    "steps": steps_of,
    "grasps": lambda: draw_chart(grasps_chart({"two": [grasps_of("copper", "wood"), grasps_of()]})),
    "responses": lambda: draw_chart(
        grasps_chart(
            {f"case {k}": [grasps_of("wood", "copper")] for k in range(5)}
            | {"last": [grasps_of("cork", "wood")]},
            ("copper", "wood"),
        )
    ),
}
DRAWN = Path(__file__).with_name("figures.txt")


def test_each_figure_shows_what_it_should_in_the_colours_widths_and_units_of_the_record() -> None:
    """``figures.txt`` has every artist; THERMOGRIP_FIGURES=write writes it anew: read the difference."""
    found = (
        "\n".join(line for name, draw in FIGURES.items() for line in (f"# {name}", *described(draw()))) + "\n"
    )
    if os.environ.get("THERMOGRIP_FIGURES") == "write":
        DRAWN.write_text(found, encoding="utf-8")
    assert found.splitlines() == DRAWN.read_text(encoding="utf-8").splitlines()


def test_a_phase_is_drawn_with_its_band_where_its_magnitude_is_on_the_axis() -> None:
    size = np.array([1.0, 1e-3, 1e-6])[:, None, None]
    found: Any = SimpleNamespace(
        linear=SimpleNamespace(outputs=("y",), inputs=("u",)),
        frequency_response=lambda: (
            np.array([0.1, 1.0, 10.0]),
            Estimate(size, 0.9 * size, 1.1 * size),
            Estimate(*(np.full((3, 1, 1), turn) for turn in (-90.0, -95.0, -85.0))),
        ),
    )
    ((above, below),) = bode_chart(found).columns
    for curve, ends in ((above.curves[0], (0.9, 1.1)), (below.curves[0], (-95.0, -85.0))):
        assert np.isfinite(curve.y).tolist() == [True, True, False]
        assert curve.low is not None
        assert curve.high is not None
        assert (curve.low[0], curve.high[0]) == ends
        assert np.isnan(curve.low[2])
        assert np.isnan(curve.high[2])


def test_a_result_is_drawn_as_its_page_shows_it(tmp_path: Path) -> None:
    plant = small_plant()
    (tmp_path / "good.csv").write_text("\n".join([HEADER, *small_log_rows()]) + "\n")
    log = read_log(tmp_path / "good.csv")
    run = simulate_closed_loop(PIController(plant), plant, [(26.0, 20.0)])
    identified = identify([log], models=["arx"])
    drawn = {
        "free run": plot(identified), "t_tank": plot(free_run(plant, log)), "t_surface": plot(plant),
        "magnitude": plot(plant, bode=True), "drive": plot(run),
    }  # fmt: skip
    for words, figure in drawn.items():
        texts = [text.get_text() for text in figure.findobj(MplText)]
        assert any(words in text for text in texts), words
    with pytest.raises(TypeError, match="there is no picture of a str"):
        plot("plant.json")  # type: ignore[arg-type]
