"""The twin is the plant, with sensors and a hand."""

from __future__ import annotations

import numpy as np
import pytest

from tests.rig.makers import STILL, make_lab
from thermogrip.datasets.errors import UserError
from thermogrip.rig.simulation.twin import Twin
from thermogrip.sysid.contact.simulation import Grip, Touch
from thermogrip.sysid.plant.plant import Plant


def test_the_tank_follows_the_exact_solution(plant: Plant) -> None:
    twin = Twin(plant, ambient=20.0, **STILL)
    twin.apply({"drive": 0.5}, 1)
    twin.wait(200.0)
    # explicit Euler at 0.5 s of a 300 s time constant
    exact = 20.0 + 0.5 * 0.4 * 300.0 * (1 - (1 - 0.5 / 300.0) ** 400)
    assert twin.read().values["t_tank"] == pytest.approx(exact, abs=1e-9)


@pytest.mark.parametrize("piece", [0.1, 0.3, 0.7])
def test_how_the_waiting_is_cut_does_not_matter(plant: Plant, piece: float) -> None:
    whole, cut = Twin(plant, **STILL), Twin(plant, **STILL)
    for twin in (whole, cut):
        twin.apply({"drive": 0.8}, 1)
    whole.wait(21.0)
    for _ in range(round(21.0 / piece)):
        cut.wait(piece)
    assert cut.time == whole.time
    np.testing.assert_allclose(list(cut.truth().values()), list(whole.truth().values()), atol=1e-9)


def test_a_drive_that_changes_within_a_step_counts_by_its_time(plant: Plant) -> None:
    twin, mean = Twin(plant, **STILL), Twin(plant, **STILL)
    for drive, seconds in ((1.0, 0.1), (0.0, 0.4)):
        twin.apply({"drive": drive}, 1)
        twin.wait(seconds)
    mean.apply({"drive": 0.2}, 1)
    mean.wait(0.5)
    np.testing.assert_allclose(list(twin.truth().values()), list(mean.truth().values()), atol=1e-12)


def test_between_two_steps_the_reading_lies_between_them(plant: Plant) -> None:
    twin = Twin(plant, **STILL)
    twin.apply({"drive": 1.0}, 1)
    seen = []
    for _ in range(11):
        seen.append(twin.truth()["t_tank"])
        twin.wait(0.1)
    assert np.all(np.diff(seen) > 0)


def test_with_the_pump_off_the_skin_leaves_the_tank_alone(plant: Plant) -> None:
    twin = Twin(plant, ambient=20.0, t_start=40.0, **STILL)
    twin.apply({"drive": 0.0}, 0)
    twin.wait(100.0)
    assert twin.truth()["t_surface"] == pytest.approx(20.0 + 20.0 * (1 - 0.5 / 2000) ** 200, abs=1e-9)


def test_readings_scatter_as_the_sensors_are_specified_to(plant: Plant) -> None:
    twin = Twin(plant, seed=1, noise=0.04, slow_noise=0.03, offsets={"t_tank": 0.5})
    error = []
    for _ in range(4000):
        twin.wait(1.0)
        error.append(twin.read().values["t_tank"] - twin.truth()["t_tank"])
    e = np.array(error) - 0.5
    # quantum 1/16: 0.018; the sd of 4000 samples with memory 4 s is known to about 3 %
    assert np.std(e) == pytest.approx(np.sqrt(0.04**2 + 0.03**2 + 0.0625**2 / 12), rel=0.08)
    lag = np.mean(e[1:] * e[:-1]) / np.var(e)
    assert lag == pytest.approx(0.03**2 * np.exp(-0.25) / np.var(e), abs=0.08)
    assert np.mean(e) == pytest.approx(0.0, abs=4 * 0.03 * np.sqrt(8 / 4000))


def test_one_seed_is_one_run_and_another_seed_another(plant: Plant) -> None:
    def run(seed: int) -> list[float]:
        twin = Twin(plant, seed=seed)
        twin.grasp("copper", 43.0)
        seen = []
        for _ in range(20):
            twin.wait(0.5)
            seen.append(twin.read().values["t_surface"])
        return seen

    assert run(1) == run(1)
    assert run(1) != run(2)
    assert all((value * 16).is_integer() for value in run(1))
    twin, rehearsed = Twin(plant, seed=1), Twin(plant, seed=1)
    assert twin.read() == twin.read()  # which draws no new noise
    rehearsed.rehearse("copper", 43.0)  # which draws none of its own
    assert rehearsed.read() == twin.read()
    with pytest.raises(UserError, match="unobtainium"):
        rehearsed.rehearse("unobtainium", 43.0)
    assert (twin.units, Twin(make_lab()).units) == ({"drive": "1"}, {"q1": "percent", "q2": "percent"})


def test_a_grasp_moves_the_skin_towards_the_object_by_the_response(plant: Plant) -> None:
    exact = Grip(
        h_c_sd_ln=0.0, build_up_sd_ln=0.0, onset=0.0, onset_sd=0.0, t_object_sd=0.0, transit_loss=0.0
    )
    twin = Twin(plant, ambient=23.0, contact=exact, **STILL)
    twin.apply({"drive": 0.0}, 0)
    touch = exact.draw("iron", 43.0, np.random.default_rng(9), ambient=23.0)
    twin.grasp("iron", 43.0)
    for t in (0.1, 0.5, 1.0, 5.0, 10.0):
        twin.wait(round(t - twin.time, 9))
        assert twin.truth()["t_surface"] == pytest.approx(23.0 + 20.0 * touch.response([t])[0], abs=1e-9)


class Exchange:
    """An object of endless heat behind one conductance: the skin goes to it with a time constant."""

    def __init__(self, tau: float, onset: float = 0.0) -> None:
        self.tau, self.onset = tau, onset

    def draw(self, material: str, t_object: float, rng: np.random.Generator, *, ambient: float) -> Touch:
        times = np.linspace(0.0, 60.0, 6001)
        return Touch(t_object, self.onset, 1.0, times, 1 - np.exp(-times / self.tau))


@pytest.mark.parametrize("onset", [0.0, 2.25])
def test_a_touched_skin_that_drifts_obeys_its_equation_of_heat(plant: Plant, onset: float) -> None:
    """T' = y' + (T_obj - T) / tau, integrated step by step, while the water cools the skin."""
    tau, twin = 3.0, Twin(plant, ambient=20.0, t_start=40.0, contact=Exchange(3.0, onset), **STILL)
    alone = Twin(plant, ambient=20.0, t_start=40.0, **STILL)
    for each in (twin, alone):
        each.apply({"drive": -1.0}, 1)
        each.wait(5.0)
    twin.grasp("copper", 18.0)
    t, h, before = alone.truth()["t_surface"], 0.05, alone.truth()["t_surface"]
    for k in range(600):
        for each in (twin, alone):
            each.wait(h)
        own = alone.truth()["t_surface"]
        if k * h < onset:
            t = own
        else:
            moved = own - before
            t = 18.0 + (t - 18.0 + 0.5 * moved) * np.exp(-h / tau) + 0.5 * moved
        before = own
        assert twin.truth()["t_surface"] == pytest.approx(t, abs=2e-3)
    assert own < 35.0  # else nothing was asked


def test_a_skin_on_a_perfect_contact_stays_at_the_object_whatever_it_would_do_alone(plant: Plant) -> None:
    twin = Twin(plant, ambient=20.0, t_start=40.0, contact=Exchange(0.01), **STILL)
    twin.apply({"drive": 0.0}, 0)
    twin.grasp("copper", 43.0)
    for _ in range(20):
        twin.wait(1.3)
        assert twin.truth()["t_surface"] == pytest.approx(43.0, abs=0.05)


def test_the_sensor_s_offset_and_the_calibration_s_bias_are_not_both_counted(plant: Plant) -> None:
    """The bias is learnt on the sensor's scale: skins that read alike before contact read alike in it."""

    def readings(offset: float) -> list[float]:
        start = 40.0 - offset  # everything this much colder, as the sensor reads too much
        rooms = {"ambient": start, "t_start": start}
        twin = Twin(plant, seed=3, offsets={"t_surface": offset}, **rooms, **STILL)
        twin.apply({"drive": 0.0}, 0)
        twin.grasp("copper", 20.0)
        seen = []
        for _ in range(6):
            twin.wait(2.0)
            seen.append(twin.read().values["t_surface"])
        return seen

    # the block relaxes by 2 % of the way to a room that is 0.5 K colder: 0.01 K
    assert readings(0.5) == pytest.approx(readings(0.0), abs=0.011)


def test_after_release_the_touch_is_forgotten(plant: Plant) -> None:
    twin = Twin(plant, ambient=23.0, **STILL)
    twin.grasp("copper", 43.0)
    twin.wait(5.0)
    held = twin.truth()["t_surface"] - 23.0
    twin.release()
    assert twin.truth()["t_surface"] - 23.0 == pytest.approx(held)
    twin.wait(40.0)
    assert twin.truth()["t_surface"] - 23.0 == pytest.approx(held * np.exp(-2.0), rel=1e-6)


def test_the_history_shows_when_the_gripper_was_closed(plant: Plant) -> None:
    twin = Twin(plant, **STILL)
    twin.wait(2.0)
    twin.grasp("wood", 43.0)
    twin.wait(3.0)
    twin.release()
    twin.wait(2.0)
    closed = [row["time_s"] for row in twin.history if row["contact"]]
    assert closed == [2.5, 3.0, 3.5, 4.0, 4.5, 5.0]


@pytest.mark.parametrize(
    ("skin", "material", "said"),
    [
        ("t_surface", "unobtainium", "unobtainium"),
        ("t_surface", "", "no material"),
        ("t_nose", "copper", "cannot grasp"),
    ],
)
def test_what_cannot_be_grasped_is_the_users_fault(plant: Plant, skin: str, material: str, said: str) -> None:
    with pytest.raises(UserError, match=said):
        Twin(plant, skin=skin).grasp(material, 43.0)


def test_a_twin_keeps_the_pace_of_who_watches_it(plant: Plant) -> None:
    waited: list[float] = []
    twin = Twin(plant, pace=waited.append)
    twin.wait(0.5)
    twin.wait(2.0)
    assert (waited, twin.time) == ([0.5, 2.0], 2.5)
