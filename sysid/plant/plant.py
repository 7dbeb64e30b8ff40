"""What every fitter returns: a model, its parameters with their uncertainty, and where both may be trusted.

A :class:`~thermogrip.sysid.models.model.Model` is equations without numbers.  A :class:`Plant` adds the
numbers: one value per parameter, the covariance of the free ones, samples of them where a posterior was
drawn, the noise of each output, and the range of the data that the fit has seen.

**Scales.**  A positive parameter is uncertain by a factor, so its ``theta`` is its logarithm; any other has
``theta`` equal to itself.  Covariance and Laplace draws live in theta; values, samples and intervals are in
natural units.

**One log is not another.**  Thermocouples are plugged anew and rooms change, so each log has sensor offsets
of its own.  ``nuisance`` says by how much (a standard deviation per signal);
:mod:`thermogrip.sysid.plant.simulation` estimates them from the warm-up of the log that it simulates.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import NormalDist
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermogrip.datasets.atomic_files import check_json, read_json, write_json
from thermogrip.datasets.errors import UserError
from thermogrip.datasets.schema import Log
from thermogrip.sysid.models.model import Array, Model, load_model
from thermogrip.sysid.plant.plant_file import (
    SCHEMA,
    VERSION,
    draws_of,
    fields_of,
    not_whole,
    plain_content,
    read_samples,
    thin,
    write_samples,
)

__all__ = ["Array", "Model", "Plant", "load_model"]


_INSIDE = 64  # so many samples stand in the plant's own file


@dataclass(frozen=True, eq=False)
class Plant:
    """A model with its numbers.

    Parameters
    ----------
    model : Model
    values : dict of str to float
        One value per parameter of the model, in natural units.
    dt : float
        Native step of the simulation [s].
    units : dict of str to str, optional
        Units of the parameters and of the signals (inputs, disturbances, outputs).
    free : tuple of str, optional
        The parameters that were estimated, in the order of ``covariance`` and ``samples``.
    scales : dict of str to str, optional
        ``"log"`` or ``"linear"`` for each free parameter (linear where absent).
    bounds : dict of str to (float, float), optional
        Where a parameter may lie; draws are kept inside.
    covariance : (n_free, n_free) ndarray, optional
        Covariance of theta (logarithm of a ``"log"`` parameter).
    samples : (n_samples, n_free) ndarray, optional
        Posterior samples in natural units.
    refits : tuple of Model, optional
        The same structure fitted to resampled logs (:mod:`thermogrip.sysid.blackbox.block_bootstrap`): what
        stands for samples where the numbers are in the model.
    noise : dict of str to float, optional
        Standard deviation of each output about the free run [degC], as the fit saw it.
    offsets : dict of str to float, optional
        Pooled sensor offsets: reading minus model.
    nuisance : dict of str to float, optional
        Spread of the offset from log to log, by output or disturbance; 0 or absent: no offset of its own.
    reference : str, optional
        The output that defines the temperature scale; it has no offset.
    valid : dict of str to (float, float), optional
        Range of each signal in the logs of the fit.
    logs : tuple of str, optional
        Names of the logs of the fit.
    scores : dict, optional
        Numbers of the fit for tables (JSON-able).
    verdict : str, optional
        One sentence: may it be used, and for what not.

    Examples
    --------
    >>> from thermogrip.sysid.models.state_space import StateSpaceModel
    >>> block = StateSpaceModel(("q",), (), ("t",), A=[[0.9]], B=[[4.0]], C=[[1.0]], dt=10.0)
    >>> plant = Plant(block, {}, dt=10.0, units={"q": "1", "t": "degC"})
    >>> plant.outputs, plant.p.shape, plant.intervals()
    (('t',), (0,), {})
    """

    model: Model
    values: dict[str, float]
    dt: float
    units: dict[str, str] = field(default_factory=dict)
    free: tuple[str, ...] = ()
    scales: dict[str, str] = field(default_factory=dict)
    bounds: dict[str, tuple[float, float]] = field(default_factory=dict)
    covariance: Array | None = None
    samples: Array | None = None
    refits: tuple[Model, ...] = ()
    noise: dict[str, float] = field(default_factory=dict)
    offsets: dict[str, float] = field(default_factory=dict)
    nuisance: dict[str, float] = field(default_factory=dict)
    reference: str | None = None
    valid: dict[str, tuple[float, float]] = field(default_factory=dict)
    logs: tuple[str, ...] = ()
    scores: dict[str, Any] = field(default_factory=dict)
    verdict: str = ""

    def __post_init__(self) -> None:
        missing = [name for name in self.model.parameters if name not in self.values]
        if missing:
            raise ValueError(f"no value for {', '.join(missing)}")
        unknown = [name for name in (*self.values, *self.free) if name not in self.model.parameters]
        if unknown:
            raise ValueError(f"the model has no parameter {', '.join(unknown)}")
        n = len(self.free)
        if self.covariance is not None and np.shape(self.covariance) != (n, n):
            raise ValueError(f"covariance is {np.shape(self.covariance)}, not {(n, n)}")
        if self.samples is not None and np.shape(self.samples)[1:] != (n,):
            raise ValueError(f"samples are {np.shape(self.samples)}, not (n, {n})")

    @property
    def uncertain(self) -> bool:
        """Whether there is anything to draw from."""
        return bool(self.refits) or self.samples is not None or self.covariance is not None

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the inputs."""
        return self.model.inputs

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the outputs."""
        return self.model.outputs

    @property
    def disturbances(self) -> tuple[str, ...]:
        """Names of the measured disturbances."""
        return self.model.disturbances

    @property
    def p(self) -> Array:
        """The parameter vector (n_p,) in the order of ``model.parameters``."""
        return np.array([self.values[name] for name in self.model.parameters], dtype=float)

    def simulate(
        self, log: Log, warmup: float = 5.0, *, score_from: float | None = None, gaps: str = "mend"
    ) -> Log:
        """Return the free run over the log; see :func:`thermogrip.sysid.plant.simulation.simulate`.

        Parameters
        ----------
        log : Log
            Inputs and disturbances of the whole log are used, measured outputs of the warm-up only.
        warmup : float, optional
            Seconds at the start (and after each gap) whose outputs set the state and the sensor offsets.
        score_from : float, optional
            Samples before this many seconds are marked unscored; the warm-up where absent.
        gaps : {"mend", "hold"}, optional
            After a gap start afresh from its own warm-up, or hold the last row through it.

        Returns
        -------
        Log
            The model's outputs at the log's times, its inputs and disturbances, and ``scored`` (1 or 0).
        """
        from thermogrip.sysid.plant.simulation import simulate  # it needs Plant

        return simulate(self, log, warmup=warmup, score_from=score_from, gaps=gaps)

    def draw(self, k: int) -> Plant:
        """Return the plant with the parameters of the k-th draw.

        Draw 0 is the plant itself.  Others come from the saved samples or refits where there are any (evenly
        spread over them), else from the Laplace approximation N(theta, covariance) with seed k.

        Raises
        ------
        UserError
            If k > 0 and the plant has nothing to draw from.
        """
        if k < 0:
            raise UserError(f"draw {k} is negative", mend="count draws from 0")
        if k == 0:
            return self
        # a golden-ratio walk visits a chain evenly, however few draws are taken
        along = (k * 0.6180339887498949) % 1.0
        if self.refits:
            return replace(self, model=self.refits[int(along * len(self.refits))])
        if self.samples is not None:
            drawn = np.asarray(self.samples[int(along * len(self.samples))], dtype=float)
        elif self.covariance is not None:
            drawn = self._laplace_draw(np.random.default_rng(k))
        else:
            raise UserError("the plant has no uncertainty to draw from", mend="fit a network, or use draw 0")
        return replace(self, values=self.values | dict(zip(self.free, drawn.tolist())))

    def intervals(self, level: float = 0.9) -> dict[str, tuple[float, float]]:
        """Return the central interval of each free parameter in natural units, by name.

        theta +- z sd, clipped to the bounds; quantiles of the samples where there is no covariance.  Samples
        are of plants that agree with the logs, and what their parameters mean may still be off
        (:mod:`thermogrip.sysid.greybox.posterior`).

        Parameters
        ----------
        level : float, optional
            Probability inside, between 0 and 1.
        """
        if not 0 < level < 1:
            raise ValueError(f"level must lie between 0 and 1, got {level:g}")
        if self.covariance is not None:
            half = NormalDist().inv_cdf(0.5 + level / 2) * np.sqrt(np.diag(self.covariance))
            low, high = self._natural(self.theta - half), self._natural(self.theta + half)
        elif self.samples is not None:
            tails = [0.5 - level / 2, 0.5 + level / 2]
            low, high = np.quantile(self.samples, tails, axis=0)
        else:
            return {}
        return {name: (float(a), float(b)) for name, a, b in zip(self.free, low, high)}

    def to_dict(self, *, draws: int | None = None) -> dict[str, Any]:
        """Return the whole plant as plain JSON: equations, values, units, covariance, samples.

        Parameters
        ----------
        draws : int, optional
            So many posterior samples, evenly spread, are kept; all where absent, for only then is the k-th
            :meth:`draw` the same on both sides.
        """
        content: dict[str, Any] = {"schema": SCHEMA, "version": VERSION} | plain_content(self)
        if self.samples is not None:
            content["draws"] = thin(self.samples, draws).tolist()
        kept: dict[str, Any] = json.loads(json.dumps(content, allow_nan=False))  # tuples become lists
        return kept

    @classmethod
    def from_dict(cls, content: Mapping[str, Any], *, model: Model | None = None) -> Plant:
        """Return the plant that :meth:`to_dict` wrote; ``model`` as for :meth:`load`.

        Raises
        ------
        UserError
            If it is not a plant, or its equations are a class that was not handed in.
        """
        body = {key: value for key, value in content.items() if key != "draws"}
        check_json(body, SCHEMA, VERSION)
        draws = content.get("draws")
        return cls._of(body, model, None if draws is None else draws_of(draws))

    def save(self, path: str | Path) -> Path:
        """Write the plant as JSON, with more than a few samples beside it as ``.nc``, and return the path."""
        target, content = Path(path), plain_content(self)
        if self.samples is not None and len(self.samples) <= _INSIDE:
            content["draws"] = np.asarray(self.samples).tolist()
        elif self.samples is not None:
            beside = target.with_suffix(".nc")
            content["samples"] = beside.name
            write_samples(beside, self.free, self.samples, self.units)
        return write_json(target, content, schema=SCHEMA, version=VERSION)

    @classmethod
    def load(cls, path: str | Path, *, model: Model | None = None) -> Plant:
        """Read a plant that :meth:`save` wrote.

        Parameters
        ----------
        path : str or Path
        model : Model, optional
            The equations, where they are the user's own code:
            :func:`thermogrip.sysid.models.user_model.own_model` of the class that was fitted (opening a file
            never runs code).

        Raises
        ------
        UserError
            If the file is missing or is not a plant, or its equations are a class that was not handed in.
        """
        content = read_json(path, SCHEMA, VERSION)
        try:
            samples = read_samples(Path(path), content.get("samples"), content.get("free", ()))
            draws = content.pop("draws", None)
            return cls._of(content, model, samples if draws is None else draws_of(draws))
        except UserError as error:
            raise UserError(error.problem, file=path, mend=error.mend) from error

    @classmethod
    def _of(cls, content: Mapping[str, Any], model: Model | None, samples: Array | None) -> Plant:
        fields = fields_of(content)
        try:
            equations = load_model(content["model"], code=model)
            refits = tuple(load_model(one) for one in content.get("refits") or ())
            return cls(model=equations, samples=samples, refits=refits, **fields)
        except UserError:
            raise
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise not_whole(error) from error

    def to_control(self, **point: Any) -> Any:
        """Return the plant about an operating point for python-control; see
        :func:`thermogrip.sysid.export.libraries.to_control`."""
        from thermogrip.sysid.export.libraries import to_control

        return to_control(self, **point)

    def to_scipy(self, **point: Any) -> Any:
        """Return the plant about an operating point for scipy; see
        :func:`thermogrip.sysid.export.libraries.to_scipy`."""
        from thermogrip.sysid.export.libraries import to_scipy

        return to_scipy(self, **point)

    def to_casadi(self, *, dt: float | None = None) -> Any:
        """Return one step as a CasADi function; see :func:`thermogrip.sysid.export.libraries.to_casadi`."""
        from thermogrip.sysid.export.libraries import to_casadi

        return to_casadi(self, dt=dt)

    def to_fmu(self, path: str | Path) -> Path:
        """Write the plant as an FMU and return the path; see :func:`thermogrip.sysid.export.fmu.to_fmu`."""
        from thermogrip.sysid.export.fmu import to_fmu

        return to_fmu(self, path)

    @property
    def theta(self) -> Array:
        """The free parameters (n_free,) as ``covariance`` has them: logarithms of the ``"log"`` ones."""
        natural = np.array([self.values[name] for name in self.free], dtype=float)
        logs = self.log_scaled
        return np.where(logs, np.log(np.where(logs, natural, 1.0)), natural)

    def _natural(self, theta: Array) -> Array:
        natural = np.where(self.log_scaled, np.exp(np.where(self.log_scaled, theta, 0.0)), theta)
        pairs = [self.bounds.get(name, (-np.inf, np.inf)) for name in self.free]
        low, high = np.array(pairs, dtype=float).reshape(-1, 2).T
        return np.asarray(np.clip(natural, low, high))

    @property
    def log_scaled(self) -> NDArray[np.bool_]:
        """Which free parameters (n_free,) are logarithms in ``theta``."""
        return np.array([self.scales.get(name) == "log" for name in self.free], dtype=bool)

    def _laplace_draw(self, rng: np.random.Generator) -> Array:
        # eigh, not Cholesky: a weakly determined direction may have lost its last digits
        size, axes = np.linalg.eigh(np.asarray(self.covariance))
        step = axes @ (np.sqrt(np.maximum(size, 0.0)) * rng.standard_normal(len(size)))
        return self._natural(self.theta + step)
