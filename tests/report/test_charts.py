"""Charts: thinning keeps what an eye looks for, and paper shows what a page shows."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from thermogrip.datasets.arrays import Array
from thermogrip.report.charts import Chart, Curve, Panel, draw_chart, stretches, thin, thinned

ROWS = st.integers(1, 400).flatmap(
    lambda n: st.lists(
        arrays(float, n, elements=st.one_of(st.floats(-1e6, 1e6), st.just(np.nan))), min_size=1, max_size=3
    )
)


@given(ROWS, st.integers(20, 200))
def test_thinning_keeps_the_ends_the_extremes_and_a_gap_of_every_column(
    columns: list[Array], most: int
) -> None:
    kept = thin(columns, most)
    assert kept.size <= max(most, min(len(columns[0]), most))
    assert (np.diff(kept) > 0).all()
    assert (kept[0], kept[-1]) == (0, len(columns[0]) - 1)
    for values in columns:
        if np.isfinite(values).any():
            assert np.nanmin(values[kept]) == np.nanmin(values)
            assert np.nanmax(values[kept]) == np.nanmax(values)
        assert np.isnan(values[kept]).any() == np.isnan(values).any()


@pytest.mark.parametrize("at", [0, 1, 31_337, 99_998, 99_999])
def test_a_peak_of_one_row_in_a_hundred_thousand_is_seen(at: int) -> None:
    y = np.sin(np.arange(100_000) / 3e4)
    y[at] = 7.0
    few = thinned(Curve("", np.arange(1e5, dtype=float), y, low=y - 1, high=y + 1), 500)
    assert few.x.size <= 500
    assert few.low is not None
    assert few.high is not None
    assert (few.x[few.y.argmax()], few.y.max(), few.high.max()) == (at, 7.0, 8.0)
    np.testing.assert_array_equal(few.high - few.low, np.full(few.x.size, 2.0))


def test_what_is_short_enough_stays_as_it_is() -> None:
    nine = np.arange(9, dtype=float)
    curve = Curve("", nine, nine)
    assert thinned(curve, 9) is curve
    assert thin([curve.y], 9).tolist() == list(range(9))


def test_stretches_are_the_runs_of_rows_and_end_where_the_next_begins() -> None:
    inside = np.array([True, True, False, False, True])
    assert stretches(np.arange(0, 50, 10, dtype=float), inside) == ((0.0, 20.0), (40.0, 40.0))
    assert stretches(np.arange(3, dtype=float), np.zeros(3, dtype=bool)) == ()


def test_paper_shows_curves_bands_marks_and_stretches_with_one_entry_a_label() -> None:
    x = np.arange(4, dtype=float)
    skin = Curve("skin", x, x, low=x - 1, high=x + 1)
    panel = Panel(
        "T [degC]", (skin, Curve("skin", x, x + 1), Curve("late", x, x, dash="")), "a run",
        shaded=((0.0, 1.0),), marks=(2.0,),
    )  # fmt: skip
    drive = Panel("drive", (Curve("drive", x, x + 1, step=True, dash="--"),), log=True)
    figure = draw_chart(Chart(((panel, drive), (panel,)), "frequency [Hz]", log=True))
    top, alone, bottom, nothing = figure.axes
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["skin", "late", "drive"]
    assert (top.get_title(), top.get_ylabel(), top.get_xscale()) == ("a run", "T [degC]", "log")
    assert (bottom.get_yscale(), bottom.get_xlabel(), alone.get_xlabel()) == ("log", "frequency [Hz]") * 1 + (
        "frequency [Hz]",
    )
    assert not nothing.axison
    assert [line.get_linestyle() for line in top.get_lines()] == [":", "-", "-", "None"]
    assert bottom.get_lines()[0].get_drawstyle() == "steps-post"
    (band,) = top.collections
    assert band.get_datalim(top.transData).y0 == -1.0
