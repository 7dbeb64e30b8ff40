"""A profile: what its file may be, and that a session follows it and shows what is ahead."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.rig.conftest import Proportional
from thermogrip.datasets.errors import UserError
from thermogrip.mpc.interface import Move, Readings
from thermogrip.rig.session.profile import Profile, read_profile, tracking_error
from thermogrip.rig.session.session import run_session
from thermogrip.rig.simulation.twin import Twin
from thermogrip.sysid.plant.plant import Plant

TIMES, TARGETS = np.array([0.0, 100.0, 100.0, 200.0]), np.array([20.0, 30.0, 40.0, 40.0])
RAMP = Profile(TIMES, {"t": TARGETS}, preview_s=20.0)


@pytest.mark.parametrize(
    ("seconds", "target"), [(0.0, 20.0), (50.0, 25.0), (99.0, 29.9), (100.0, 40.0), (999.0, 40.0)]
)
def test_a_target_is_on_the_line_between_two_rows_and_two_at_one_time_are_a_jump(
    seconds: float, target: float
) -> None:
    assert RAMP.at(seconds)["t"] == pytest.approx(target)


def test_what_is_ahead_are_the_targets_of_the_next_samples() -> None:
    assert RAMP.ahead(90.0, 5.0)["t"] == pytest.approx([29.0, 29.5, 40.0, 40.0, 40.0])
    assert RAMP.seconds == 200.0


@pytest.mark.parametrize(
    ("text", "outputs", "at_60_s"),
    [("time_s,target_degC\n0,20\n120,40\n", ("a", "b"), {"a": 30.0, "b": 30.0}),
     ("time_min,a_degC,b_K\n5,20,293.15\n7,40,313.15\n", ("a", "b"), {"a": 30.0, "b": 30.0}),
     ("time_ms,b_degF,a_degC\n0,68,20\n120000,104,20\n", ("a", "b"), {"a": 20.0, "b": 30.0})],
)  # fmt: skip
def test_a_file_may_have_any_unit_and_one_target_for_all(
    tmp_path: Path, text: str, outputs: tuple[str, ...], at_60_s: dict[str, float]
) -> None:
    path = tmp_path / "p.csv"
    path.write_text(text)
    assert read_profile(path, outputs).at(60.0) == pytest.approx(at_60_s)


@pytest.mark.parametrize(
    ("text", "words"),
    [("time_s,c_degC\n0,20\n9,30\n",
      "has the columns time_s, c_degC; write time_s and target_degC, or time_s and a_degC"),
     ("time_s,a_degC,target_degC\n0,20,1\n9,30,1\n", "has the columns"),
     ("time_s,a\n0,20\n9,30\n", "column a: has another unit; write time_s and t1_degC"),
     ("time_s,a_degC\n0,20\n9,\n", "row 3, column a_degC: is empty; write a number"),
     ("time_s,a_degC\n0,20\n9,30\n5,30\n", "row 4: does not go on in time"),
     ("time_s,a_degC\n3,20\n3,30\n", "row 3: does not go on in time; give two times or more, in order"),
     ("time_s,a_degC\n3,20\n", "row 2: does not go on in time")],
)  # fmt: skip
def test_a_file_that_is_no_profile_is_refused_in_one_line(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "p.csv"
    path.write_text(text)
    with pytest.raises(UserError) as refused:
        read_profile(path, ("a",))
    assert words in str(refused.value)


class Looking(Proportional):
    """A controller that keeps what it was shown, and regulates to the target of now."""

    shown: list[list[float]]

    def step(self, reading: Readings, target: object) -> Move:
        assert isinstance(target, dict)
        self.shown.append(target["t_surface"])
        return super().step(reading, target["t_surface"][0])


def test_a_session_follows_a_profile_to_its_end_and_shows_the_controller_what_comes(plant: Plant) -> None:
    controller = Looking()
    controller.shown = []
    time, targets = np.array([0.0, 200.0, 400.0]), np.array([25.0, 33.0, 33.0])
    profile = Profile(time, {"t_surface": targets}, preview_s=5.0)
    session = run_session(Twin(plant, seed=1), controller, profile.at(0.0), profile=profile)
    assert (session.verdict, session.advice) == ("followed", "")
    assert controller.shown[10] == pytest.approx([25.4, 25.44, 25.48, 25.52, 25.56, 25.6])
    log = session.log
    assert log["time"].values[-1] == pytest.approx(399.0)
    np.testing.assert_allclose(log["target_t_surface"].values[:201], np.linspace(25.0, 33.0, 201))
    rms, largest = tracking_error(log, ["t_surface"])
    assert 0.0 < rms < largest < 1.5
    assert session.bias == pytest.approx(float((log["t_surface"] - log["target_t_surface"]).mean()))
    assert np.isnan(session.settle_time)


def test_a_profile_beyond_the_limits_is_refused_before_anything_is_driven(plant: Plant) -> None:
    twin = Twin(plant, seed=1)
    profile = Profile(np.array([0.0, 60.0]), {"t_surface": np.array([25.0, 80.0])})
    with pytest.raises(UserError, match="target 80 degC is unsafe"):
        run_session(twin, Proportional(), profile.at(0.0), profile=profile)
    assert all(row["drive"] == 0.0 for row in twin.history)
