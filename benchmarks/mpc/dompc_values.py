"""Numbers of do-mpc's time-varying parameters that change from sample to sample and hold over the horizon."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any


def hold_over_horizon(controller: Any, horizon: int, values: Callable[[], Mapping[str, float]]) -> None:
    """Let a do-mpc controller ask for its parameters at each sample."""
    template = controller.get_tvp_template()

    def time_varying(_: Any) -> Any:
        for k in range(horizon + 1):
            for name, value in values().items():
                template["_tvp", k, name] = value
        return template

    controller.set_tvp_fun(time_varying)
