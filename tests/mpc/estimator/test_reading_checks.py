"""What is reported of a plant that the model no longer explains."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from thermogrip.mpc.estimator.reading_checks import follows


@pytest.mark.parametrize(
    ("bias", "offsets", "switches", "said"),
    [
        (0.1, [0.5, -0.5], ("pump",), ""),
        (0.9, [0.0, 0.0], (), "skin does not follow the drive: is it another plant?"),
        (-0.9, [9.0, 0.0], ("pump",), "skin does not follow the drive: does the pump run?"),
        (0.0, [1.0, -9.0], (), "skin is far from the model: is the sensor in place?"),
        (
            0.0,
            [9.0, 1.0],
            ("pump",),
            "tank is far from the model: does the pump run, is the sensor in place?",
        ),
    ],
)
def test_what_the_model_does_not_explain_is_reported_of_the_drive_first(
    bias: float, offsets: list[float], switches: tuple[str, ...], said: str
) -> None:
    model = SimpleNamespace(model=SimpleNamespace(switches=switches), outputs=("tank", "skin"))
    off = SimpleNamespace(disturbance=SimpleNamespace(on_drive=np.eye(1)), model=model, w=np.array([bias]))
    off.offset = np.array([0.3, -0.2])
    off.output_bias = off.offset + offsets
    assert follows(off, ("skin",)) == said  # type: ignore[arg-type]
