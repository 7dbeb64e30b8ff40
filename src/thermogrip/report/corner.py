"""The corner figure of a posterior: each pair of parameters, marginals on the diagonal.

Where two parameters trade off, their panel is a ridge: neither is known well, a combination
is.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.errors import UserError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from thermogrip.sysid.greybox.posterior import Posterior

__all__ = ["corner_figure"]

Array = NDArray[np.float64]


def corner_figure(posterior: Posterior, names: Sequence[str] | None = None) -> Figure:
    """Draw the samples of each pair of parameters, with marginals and the fitted values.

    Parameters
    ----------
    posterior : Posterior
    names : sequence of str, optional
        Default the sampled parameters.

    Raises
    ------
    UserError
        If a name is not a free parameter.
    """
    from matplotlib.figure import Figure

    names = posterior.sampled if names is None else tuple(names)
    for name in names:
        if name not in posterior.free:
            raise UserError(f"{name!r} was not sampled", mend=f"choose from {', '.join(posterior.free)}")
    columns = posterior.samples[:, [posterior.free.index(name) for name in names]]
    n = len(names)
    figure = Figure(figsize=(1.7 * n + 0.6, 1.7 * n + 0.6), layout="constrained")
    axes = figure.subplots(n, n, squeeze=False)
    for i in range(n):
        for j in range(n):
            _corner_panel(axes[i, j], columns, names, posterior, i, j)
    return figure


def _corner_panel(
    ax: Any, columns: Array, names: Sequence[str], posterior: Posterior, i: int, j: int
) -> None:
    """Draw row i, column j of the corner figure."""
    if j > i:
        ax.set_axis_off()
        return
    ax.tick_params(labelsize=6)
    ax.axvline(posterior.fitted[names[j]], color="0.6", lw=0.8)
    if i == j:
        ax.hist(columns[:, i], bins=25, color="tab:blue", alpha=0.6)
        for edge in (posterior.quantiles[names[i]][0], posterior.quantiles[names[i]][2]):
            ax.axvline(edge, color="tab:blue", lw=0.8, ls="--")
        ax.set_yticks([])
    else:
        ax.plot(columns[:, j], columns[:, i], ".", ms=1.5, alpha=0.4)
        ax.axhline(posterior.fitted[names[i]], color="0.6", lw=0.8)
        ax.tick_params(labelleft=j == 0)  # a row shares its scale
    if i == len(names) - 1:
        ax.set_xlabel(f"{names[j]} [{posterior.units.get(names[j], '1')}]", fontsize=7)
    if j == 0 and i > 0:
        ax.set_ylabel(f"{names[i]} [{posterior.units.get(names[i], '1')}]", fontsize=7)
