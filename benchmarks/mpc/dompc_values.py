"""Numbers of do-mpc's time-varying parameters that change from sample to sample; over the horizon they
hold, or go along a sequence whose last one stays."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np


def hold_over_horizon(controller: Any, horizon: int, values: Callable[[], Mapping[str, Any]]) -> None:
    """Let a do-mpc controller ask for its parameters at each sample."""
    template = controller.get_tvp_template()

    def time_varying(_: Any) -> Any:
        for k in range(horizon + 1):
            for name, value in values().items():
                line = np.ravel(value)
                template["_tvp", k, name] = float(line[min(k, len(line) - 1)])
        return template

    controller.set_tvp_fun(time_varying)
