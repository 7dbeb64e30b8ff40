"""Whatever takes a Log or Grasps from Python takes the path of a file as well, of a log a DataFrame too."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from tests.end_to_end.conftest import HEADER, small_grasps, small_log_rows, small_plant
from thermogrip.classify import classify_grasps, evaluate, make_classifier
from thermogrip.datasets import read_grasps
from thermogrip.sysid import Plant, check_data, free_run, identify, read_log
from thermogrip.sysid.effusivity import effusivity_posterior, load_default_gripper


@pytest.fixture
def log_file(tmp_path: Path) -> Path:
    path = tmp_path / "log.csv"
    path.write_text("\n".join([HEADER, *small_log_rows()]) + "\n")
    return path


@pytest.fixture
def grasps_file(tmp_path: Path) -> Path:
    for name, text in zip(("grasps.csv", "grasps_meta.csv"), small_grasps()):
        (tmp_path / name).write_text(text)
    return tmp_path / "grasps.csv"


LOGS: list[Any] = [
    lambda plant, log: plant.simulate(log)["t_tank"].values,
    lambda plant, log: [free_run(plant, log).scores["t_tank"].rmse, free_run(plant, log).band().level],
    lambda plant, log: [len(check_data(log, outputs=["t_tank"]).findings)],
    pytest.param(
        lambda plant, log: identify(log, models=["arx"], draws=2).plant.model.A.ravel(),
        marks=pytest.mark.slow,
    ),
]


@pytest.mark.parametrize("use", LOGS)
def test_a_log_is_a_record_a_path_or_a_frame(use: Callable[[Plant, Any], Any], log_file: Path) -> None:
    plant = small_plant()
    ours = use(plant, read_log(log_file))
    for other in (str(log_file), pd.read_csv(log_file)):
        np.testing.assert_allclose(use(plant, other), ours, rtol=1e-12, strict=True)


GRASPS: list[Callable[[Any], Any]] = [
    lambda grasps: [
        row["p_copper"] for row in classify_grasps(make_classifier("features-lda").fit(grasps), grasps)
    ],
    lambda grasps: [evaluate(["features-lda"], grasps, probe=False).scores()[0]["log_loss"]],
    lambda grasps: [row.effusivity for row in effusivity_posterior(load_default_gripper(), grasps)],
]


@pytest.mark.parametrize("use", GRASPS)
def test_grasps_are_a_record_or_a_path(use: Callable[[Any], Any], grasps_file: Path) -> None:
    np.testing.assert_allclose(use(grasps_file), use(read_grasps(grasps_file)), rtol=1e-9, strict=True)
