"""Members that run apart say that a free run cannot be believed, and it is refused with a sentence."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import make_log
from thermogrip.sysid.cross_validation import Held, run_held_out
from thermogrip.sysid.models.neural import NeuralModel
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.plant import Plant
from thermogrip.sysid.validation.ensemble_spread import APART, members_apart, refuse_strays


def pair(bend: float, *, size: float = 2.0) -> Plant:
    """Two members of one block; one is pushed by ``bend`` spreads at large drives."""
    model = NeuralModel(
        ("q",), (), ("t",), (), 1.0,
        A=[[[0.9]]] * 2, B=[[[0.1]]] * 2, c=[[0.0]] * 2,
        V=[[[0.0]], [[0.1 * bend]]], W=[[[0.0]]] * 2, U=[[[1.0]]] * 2, b=[[0.0]] * 2,
        y_middle=[30.0], y_size=[size], w_middle=[0.0], w_size=[1.0], reach=[9.0],
        low=[-np.inf], high=[np.inf],
    )  # fmt: skip
    return Plant(model, {}, dt=1.0, units={"q": "1", "t": "degC"}, noise={"t": 0.1})


def driven(q: float, rows: int = 400):
    u, t = np.full(rows, q), np.full(rows, 30.0)
    return make_log(np.arange(float(rows)), {"q": (u, "1", "input"), "t": (t, "degC", "output")}, name="far")


@pytest.mark.parametrize("bend", [0.2, 0.6, 2.0])
def test_the_share_is_half_the_difference_of_two_members_at_rest(bend):
    # a gain of 1 / (1 - 0.9) on 0.1 bend tanh(9), so they end `bend` spreads apart: 1/2 each from the mean
    share = members_apart(pair(bend), driven(9.0, 4000))["t"]
    assert share == pytest.approx(bend / 2, rel=0.02)
    assert members_apart(pair(bend, size=7.0), driven(9.0, 4000))["t"] == pytest.approx(share)


def stepped(time: np.ndarray, on: np.ndarray):
    q, t = 9.0 * on, np.full(time.size, 30.0)
    return make_log(time, {"q": (q, "1", "input"), "t": (t, "degC", "output")}, name="stepped")


def test_the_share_is_an_rms_over_the_log_at_the_models_own_pace():
    k = np.arange(20)  # after the drive the members part as 1 - 0.9^k
    share = members_apart(pair(1.0), stepped(np.arange(120.0), np.arange(120) >= 100))["t"]
    assert share == pytest.approx(0.5 * np.sqrt(np.sum((1 - 0.9**k) ** 2) / 120), rel=0.05)


def test_what_comes_after_a_gap_counts_as_much():
    time = np.concatenate([np.arange(2000.0), 2100.0 + np.arange(2000.0)])
    share = members_apart(pair(1.0), stepped(time, time > 2050))["t"]
    assert share == pytest.approx(0.5 * np.sqrt(1 / 2), rel=0.02)


def test_a_disturbance_is_read_less_its_offset():
    model = NeuralModel(
        ("q",), ("room",), ("t",), (), 1.0,
        A=[[[0.9]]] * 2, B=[[[0.1, 0.0]]] * 2, c=[[0.0]] * 2,
        V=[[[0.0]], [[0.1]]], W=[[[0.0]]] * 2, U=[[[0.0, 1.0]]] * 2, b=[[0.0]] * 2,
        y_middle=[30.0], y_size=[2.0], w_middle=[0.0, 20.0], w_size=[1.0, 1.0], reach=[9.0, 9.0],
        low=[-np.inf], high=[np.inf],
    )  # fmt: skip

    def apart(room: float, offset: float) -> float:
        log = driven(0.0).assign(room=("time", np.full(400, room), {"units": "degC", "role": "disturbance"}))
        return members_apart(Plant(model, {}, dt=1.0, offsets={"room": offset}), log)["t"]

    assert apart(25.0, 5.0) == apart(20.0, 0.0) == pytest.approx(0.0, abs=1e-9)
    assert apart(20.0, 5.0) == pytest.approx(apart(15.0, 0.0)) == pytest.approx(0.5, rel=0.05)


def test_only_the_outputs_count_of_the_states():
    plant = pair(1.0)
    grow = {name: np.zeros((2, 2, 2)) for name in ("A",)} | {"B": np.zeros((2, 2, 1)), "c": np.zeros((2, 2))}
    grow |= {"V": np.zeros((2, 2, 1)), "W": np.zeros((2, 1, 2)), "spread": np.empty(0)}
    grow["A"][:, 0, 0], grow["A"][:, 1, 1], grow["B"][:, 0, 0] = 0.9, 0.5, 0.1
    grow["V"][1, 0, 0] = 0.1
    grow["c"][1, 1] = 7.0  # a state that nobody reads, 14 apart
    wide = Plant(replace(plant.model, **grow), {}, dt=1.0)
    assert members_apart(wide, driven(9.0)) == pytest.approx(members_apart(plant, driven(9.0)), rel=0.05)


def test_members_that_agree_pass_and_those_that_do_not_are_refused_in_words():
    refuse_strays(pair(1.9 * APART), driven(9.0))
    with pytest.raises(UserError, match=r"run apart over far: t by 4\d %"):
        refuse_strays(pair(2.2 * APART), driven(9.0))
    refuse_strays(pair(5.0), driven(0.0))  # no drive, nothing to disagree about
    with pytest.raises(UserError, match=r"run apart over far: t by .* mean tells nothing"):
        refuse_strays(pair(5.0), driven(9.0))


def test_readings_after_the_warm_up_do_not_enter():
    log = driven(9.0)
    other = log.assign(t=("time", np.where(np.arange(400) < 5, 30.0, 99.0), log["t"].attrs))
    assert members_apart(pair(1.0), log, warmup=4.0) == members_apart(pair(1.0), other, warmup=4.0)


def test_a_plant_without_members_has_nothing_to_refuse():
    block = StateSpaceModel(("q",), (), ("t",), A=[[0.9]], B=[[0.1]], C=[[1.0]], dt=1.0)
    assert members_apart(Plant(block, {}, dt=1.0), driven(1.0)) == {}


def test_the_ladder_prints_no_held_out_figure_of_members_that_run_apart():
    held = Held(driven(9.0), "far", 0.0)
    with pytest.raises(UserError, match="run apart"):
        run_held_out(pair(5.0), held, unseen=True)
    assert run_held_out(pair(0.1), held, unseen=True).scores
    assert len(run_held_out(pair(5.0), held).scores) == 1
