"""The prediction of a plant of several drives, or of a drive that is never at nought."""

from __future__ import annotations

import numpy as np
import pytest

from thermogrip.mpc.plant.prediction import PredictionModel, step_response
from thermogrip.sysid.greybox.problem import prior_plant
from thermogrip.sysid.models.network import load_network
from thermogrip.sysid.models.state_space import StateSpaceModel
from thermogrip.sysid.plant.plant import Plant


def test_each_output_answers_to_each_block_of_each_drive_as_differences_say() -> None:
    model = PredictionModel(prior_plant(load_network("tclab")), dt=4.0)
    x, d = model.rest([30.0, 26.0], np.zeros(0)), np.zeros(0)
    plan, blocks = np.array([[40.0, 10.0], [5.0, 60.0], [20.0, 20.0]]), [1, 2, 4]

    def outputs(plan: np.ndarray) -> np.ndarray:
        return model.run(x[None], np.repeat(plan, blocks, axis=0)[None], d)[0][0, 1:]

    y, G = model.trajectory(x, plan, d, blocks)
    np.testing.assert_allclose(y, outputs(plan), atol=1e-9)
    assert G.shape == (7, 2, 3, 2)
    for b in range(3):
        for j in range(2):
            bit = np.zeros((3, 2))
            bit[b, j] = 0.01
            slope = (outputs(plan + bit) - outputs(plan - bit)) / 0.02
            np.testing.assert_allclose(G[:, :, b, j], slope, atol=1e-7)
    assert G[0, 0, 0, 0] > 2 * abs(G[0, 0, 0, 1])  # the own heater first
    assert (G[0, :, 1:] == 0).all()  # nothing answers to what is still to come


def test_a_sample_is_cut_into_no_fewer_steps_than_a_hundredth_of_a_degree_allows() -> None:
    plant = prior_plant(load_network("gripper"))
    model = PredictionModel(plant, dt=2.0)
    assert model.sub < round(2.0 / plant.dt)  # it is cut into fewer than the plant's own
    rng = np.random.default_rng(0)
    plan = np.repeat(rng.uniform(-1, 1, (1, 6, 1)), 10, axis=1)
    x, d = model.rest([25.0, 25.0], [25.0]), np.array([25.0])
    y, _ = model.run(x[None], plan, d)
    fine = np.repeat(model.inputs(plan), round(2.0 / plant.dt), axis=1)
    room = np.full((1, fine.shape[1], 1), 25.0)
    exact, _ = plant.model.rollout(x[None], fine, room, plant.p[None], plant.dt)
    assert np.abs(y[0] - exact[0, :: round(2.0 / plant.dt)]).max() < 0.02


def lag(valid: tuple[float, float], disturbances: tuple[str, ...] = ()) -> Plant:
    model = StateSpaceModel(
        ("q",), disturbances, ("t",), A=[[0.98]], B=[[0.1]], E=np.zeros((1, len(disturbances))),
        C=[[1.0]], dt=1.0, y0=[25.0],
    )  # fmt: skip
    units = {"q": "W", "t": "degC"} | dict.fromkeys(disturbances, "degC")
    return Plant(model, {}, dt=1.0, units=units, valid={"q": valid})


@pytest.mark.parametrize(
    ("valid", "neutral"), [((0.0, 4.0), 0.0), ((1.0, 4.0), 1.0), ((-4.0, 0.0), 0.0), ((-4.0, -1.0), -1.0)]
)
def test_no_drive_is_what_is_nearest_to_none_and_a_step_from_there_stays_in_range(
    valid: tuple[float, float], neutral: float
) -> None:
    plant = lag(valid)
    model = PredictionModel(plant, dt=1.0)
    assert model.neutral.tolist() == [neutral]
    assert model.span.tolist() == [valid[1] - valid[0]]
    answer = step_response(plant, "q", "t")
    assert answer.gain == pytest.approx(5.0 * (valid[1] - valid[0]), rel=0.01)
    assert answer.lag == pytest.approx(-1 / np.log(0.98), rel=0.05)
    assert answer.delay < 1.0


def test_the_room_is_the_first_of_what_is_measured() -> None:
    model = PredictionModel(lag((0.0, 4.0), ("t_room", "t_water")), dt=1.0)
    assert [model.room(d) for d in ([21.0, 30.0], [np.nan, 30.0], [21.0, np.nan])] == [21.0, 25.0, 21.0]
