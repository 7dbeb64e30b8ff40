"""Closed loops on a sheet: every artist is as its record has it."""

from __future__ import annotations

import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from tests.report.conftest import described
from thermogrip.datasets.limits import LARGEST
from thermogrip.report.charts import draw_chart
from thermogrip.report.plots import closed_loop_chart

DRAWN = Path(__file__).with_name("closed_loop_chart.txt")


def run() -> Any:
    time, sample = np.arange(0.0, 3001.0), np.arange(0.0, 3001.0, 300.0)
    wave = 30.0 + np.sin(time / 300)
    segments = [SimpleNamespace(begin_s=at, settle_s=settle) for at, settle in ((0.0, 60.0), (900.0, np.nan))]
    return SimpleNamespace(
        time=time, outputs={"skin": wave, "tank": wave + 1}, sample_time=sample, segments=segments, band=0.2,
        target={"skin": np.full(11, 30.0)}, drive={"q": np.linspace(0.1, 0.9, 11)},
        drive_range={"q": (0.0, 1.0)}, status=("ok",) * 9 + ("late", "infeasible"),
    )  # fmt: skip


def test_each_figure_shows_what_it_should_in_the_colours_widths_and_units_of_the_record() -> None:
    """``closed_loop_chart.txt`` has every artist; THERMOGRIP_FIGURES=write writes it: read the difference."""
    alone: Any = SimpleNamespace(**{**vars(run()), "outputs": {"skin": run().outputs["skin"]}})
    figures: dict[str, Figure] = {
        "closed loop": draw_chart(closed_loop_chart(run(), limits={"tank": (20.0, 45.0)})),
        "closed loop of one output": draw_chart(closed_loop_chart(alone)),
    }
    found = [line for name, figure in figures.items() for line in (f"# {name}", *described(figure))]
    if os.environ.get("THERMOGRIP_FIGURES") == "write":
        DRAWN.write_text("\n".join(found) + "\n", encoding="utf-8")
    assert found == DRAWN.read_text(encoding="utf-8").splitlines()


def test_an_open_end_of_a_limit_is_not_drawn() -> None:
    chart = closed_loop_chart(run(), limits={"tank": (-LARGEST, 45.0)})
    (ends,) = [curve.y for curve in chart.columns[0][1].curves if curve.label == "limits of tank"]
    assert ends.tolist() == [45.0, 45.0]
