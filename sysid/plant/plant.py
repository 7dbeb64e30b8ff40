"""What every fitter returns: a model with its numbers (:mod:`thermogrip.sysid.plant.plant_data`).

A :class:`Plant` is simulated, drawn from, saved, and handed to other libraries.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from thermogrip.datasets.arrays import Array
from thermogrip.datasets.errors import UserError, known_names, reading
from thermogrip.datasets.files import check_json, read_json, write_json
from thermogrip.datasets.schema import Log, column, log_name, make_log
from thermogrip.media.rendering import Shown
from thermogrip.sysid.models.model import Model, whole_steps
from thermogrip.sysid.plant import plant_data
from thermogrip.sysid.plant.log_grid import Stretch, at_rows, cut_stretches, match_logs
from thermogrip.sysid.plant.simulation import AFTER_GAP, Start, find_starts, predict

if TYPE_CHECKING:
    from pandas import DataFrame

WARMUP = 5.0  # s of readings that set the state, where nothing else is asked for
_SHOWN = 10  # free parameters where a plant shows itself
_SAMPLES_IN_FILE = 64  # so many samples stand in the plant's own file
#: By ``kind``, where a model's class is; a file can name no other code.
_MODELS = {
    "network": ("network", "NetworkModel"),
    "statespace": ("state_space", "StateSpaceModel"),
    "neural": ("neural", "NeuralModel"),
    "sindy": ("polynomial", "SindyModel"),
    "own": ("user_model", "OwnModel"),
}


def said_not_good(verdict: str) -> bool:
    """Return whether ``identify`` called a plant not good: its verdict, a string, is all that files keep."""
    return "not good" in verdict.lower()


@dataclass(frozen=True, eq=False, repr=False)
class Plant(Shown, plant_data.PlantData):
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
        Covariance of theta: of the logarithm of a ``"log"`` parameter, of another in its unit.
    samples : (n_samples, n_free) ndarray, optional
        Posterior samples in natural units.
    refits : tuple of Model, optional
        The same structure fitted to resampled logs (:mod:`thermogrip.sysid.blackbox.fit`): what
        replaces samples where the numbers are in the model.
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
    nominal : dict of str to float, optional
        What a measured disturbance is where nobody reads it; of a fit the median of its logs, but for the
        room's temperature.
    logs : tuple of str, optional
        Names of the logs of the fit.
    scores : PlantScores, optional
        Numbers of the fit for tables, bands and later fits.
    verdict : str, optional
        One sentence: may it be used, and for what not.
    fitted_to : tuple of FitLog, optional
        Of each log of the fit the hash of its data and the seconds that were used; a file of version 0.1.0
        has none.
    inputs_end_at_row : bool, optional
        Whether an input of the logs was applied up to the row that holds it; where False, from it on.
    offset_memory : float, optional
        Seconds in which a log's own offset falls to 1/e after the warm-up; infinite where it lasts.

    Examples
    --------
    >>> from thermogrip.sysid.models.state_space import StateSpaceModel
    >>> block = StateSpaceModel(("q",), (), ("t",), A=[[0.9]], B=[[4.0]], C=[[1.0]], dt=10.0)
    >>> plant = Plant(block, {}, dt=10.0, units={"q": "1", "t": "degC"})
    >>> plant.outputs, plant.p.shape, plant.intervals()
    (('t',), (0,), {})
    """

    def _facts(self) -> dict[str, object]:
        """Return equations, signals, the free parameters with their 90 % intervals, and the verdict."""
        facts: dict[str, object] = {"model": f"{self.model.kind}, a step of {self.dt:g} s"}
        for role in ("inputs", "disturbances", "outputs"):
            facts[role] = ", ".join(f"{n} [{self.units.get(n, '1')}]" for n in getattr(self, role)) or "none"
        ranges = self.intervals() if self.uncertain else {}
        for name in self.free[:_SHOWN]:
            between = " (90 %: {:.4g} to {:.4g})".format(*ranges[name]) if name in ranges else ""
            facts[name] = f"{self.values[name]:.4g} {self.units.get(name, '')}{between}"
        facts |= {"...": f"{len(self.free) - _SHOWN} more parameters"} if len(self.free) > _SHOWN else {}
        return facts | {"logs": ", ".join(self.logs) or "none", "verdict": self.verdict or "none"}

    def simulate(
        self,
        log: Log | DataFrame | str | Path,
        warmup: float = WARMUP,
        *,
        score_from: float | None = None,
        gaps: str = "restart",
    ) -> Log:
        """Return the free run over the log (:mod:`thermogrip.sysid.plant.simulation`).

        Parameters
        ----------
        log : Log, DataFrame, str or Path
            Inputs and disturbances of the whole log are used, measured outputs of the warm-up only.
        warmup : float, optional
            Seconds at the start (and after each gap) whose outputs set the state and the sensor offsets.
        score_from : float, optional
            Samples before this many seconds are marked unscored; the warm-up where absent.
        gaps : {"restart", "hold"}, optional
            After a gap start afresh from its own warm-up, or hold the last row through it.

        Returns
        -------
        Log
            The model's outputs at the log's times, its inputs and disturbances, and ``scored`` (1 or 0).

        Raises
        ------
        UserError
            If a signal is missing or in another unit, or the warm-up is not positive.

        Examples
        --------
        >>> from thermogrip.datasets.schema import make_log
        >>> from thermogrip.sysid.models.state_space import StateSpaceModel
        >>> block = StateSpaceModel(("q",), (), ("t",), A=[[0.9]], B=[[4.0]], C=[[1.0]], dt=10.0)
        >>> q, t = np.repeat([0.0, 1.0], 60), np.zeros(120)
        >>> log = make_log(10.0 * np.arange(120), {"q": (q, "1", "input"), "t": (t, "degC", "output")})
        >>> Plant(block, {}, dt=10.0).simulate(log, warmup=50.0)["t"].values[[59, -1]].round(1).tolist()
        [0.0, 39.9]
        """
        if gaps not in ("restart", "hold"):
            raise ValueError(f"gaps is 'restart' or 'hold', not {gaps!r}")
        if not warmup > 0:
            raise UserError(f"a warm-up of {warmup:g} s says nothing", hint="give it a few seconds")
        (log,), notes = match_logs(self, [log])
        stretches = cut_stretches(self, log, gaps=gaps)
        y, starts = self.over(stretches, warmup)
        time = log["time"].values
        scored = time - float(time[0]) >= (warmup if score_from is None else score_from)
        for stretch in stretches:
            if stretch.gap:
                scored[stretch.rows] &= stretch.time >= AFTER_GAP
        variables = {n: (y[:, k], self.units.get(n, "degC"), "output") for k, n in enumerate(self.outputs)}
        for role, group in (("input", self.inputs), ("disturbance", self.disturbances)):
            variables |= {n: (column(log, n), str(log[n].attrs["units"]), role) for n in group}
        variables["scored"] = (scored.astype(float), "1", "other")
        simulated = make_log(time, variables, name=log_name(log))
        simulated.attrs["notes"] = "\n".join([*notes, *(start.how for start in starts)])
        return simulated

    def over(self, stretches: Sequence[Stretch], warmup: float) -> tuple[Array, list[Start]]:
        """Return the free run at the rows of all stretches of a log, (n, n_y), and how each starts."""
        try:
            with np.errstate(over="ignore", invalid="ignore"):  # a run that diverges is infinite, an answer
                starts = find_starts(self, self.p, stretches, warmup)
                runs = predict(self.model, self.dt, self.p[None], stretches, starts)
                run_at_rows = [at_rows(stretch, run, self.dt)[0] for stretch, run in zip(stretches, runs)]
        except np.linalg.LinAlgError as error:
            hint = "identify the plant again"
            raise UserError("the plant's run is not finite", file=stretches[0].log, hint=hint) from error
        return np.concatenate(run_at_rows), starts

    def to_dict(self, *, draws: int | None = None) -> dict[str, Any]:
        """Return the whole plant as plain JSON, with so many posterior samples, evenly spread; with all where
        ``draws`` is absent, for only then is the k-th :meth:`draw` the same on both sides."""
        content: dict[str, Any] = {
            "schema": plant_data.SCHEMA,
            "version": plant_data.VERSION,
        } | plant_data.plain_content(self)
        if self.samples is not None:
            content["draws"] = plant_data.thin(self.samples, draws).tolist()
        plain: dict[str, Any] = json.loads(json.dumps(content, allow_nan=False))  # tuples become lists
        return plain

    @classmethod
    def from_dict(cls, content: Mapping[str, Any], *, model: Model | None = None) -> Plant:
        """Return the plant that :meth:`to_dict` wrote; ``model`` and errors as for :meth:`load`."""
        check_json(content, plant_data.SCHEMA, plant_data.VERSION)
        return cls._of(content, model, content.get("draws"))

    def save(self, path: str | Path) -> Path:
        """Write the plant as JSON, with more than a few samples beside it as ``.nc``, and return the path."""
        target, content = Path(path), plant_data.plain_content(self)
        if self.samples is not None and len(self.samples) <= _SAMPLES_IN_FILE:
            content["draws"] = np.asarray(self.samples).tolist()
        elif self.samples is not None:
            beside = target.with_suffix(".nc")
            content["samples"] = beside.name
            plant_data.write_samples(beside, self.free, self.samples, self.units)
        return write_json(target, content, schema=plant_data.SCHEMA, version=plant_data.VERSION)

    @classmethod
    def load(cls, path: str | Path, *, model: Model | None = None) -> Plant:
        """Return the plant that :meth:`save` wrote.

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

        Examples
        --------
        >>> Plant.load("plant.json").simulate(log)  # doctest: +SKIP
        """
        content = read_json(path, plant_data.SCHEMA, plant_data.VERSION)
        with reading("is not a whole plant", file=path, hint="save the plant again"):
            samples = plant_data.read_samples(Path(path), content.get("samples"), content.get("free", ()))
            return cls._of(content, model, content.get("draws", samples))

    @classmethod
    def _of(cls, content: Mapping[str, Any], model: Model | None, samples: Any) -> Plant:
        fields = plant_data.fields_of(content)
        with plant_data.whole_plant():
            equations = _load_model(content["model"], code=model)
            refits = tuple(_load_model(one) for one in content.get("refits") or ())
            drawn = None if samples is None else np.asarray(samples, dtype=float)
            return cls(model=equations, samples=drawn, refits=refits, **fields)

    def to_control(self, **point: Any) -> Any:
        """Return the plant about an operating point as a python-control ``StateSpace``.

        Its signals are changes from that point, by the plant's names (dots in the names of states become
        underscores).

        Parameters
        ----------
        **point
            As for :func:`thermogrip.sysid.plant.linearise.linearise_plant`, which has the point as well.

        Raises
        ------
        UserError
            If ``control`` is not installed, or there is no linear model at the point.

        Examples
        --------
        >>> from thermogrip.sysid.greybox.problem import prior_plant
        >>> from thermogrip.sysid.models.network import load_network
        >>> system = prior_plant(load_network("tclab")).to_control(inputs={"q1": 30.0})
        >>> system.input_labels, system.output_labels, bool(max(system.poles().real) < 0)
        (['q1', 'q2'], ['t1', 't2'], True)
        """
        from thermogrip.sysid.plant.linearise import control_system, linearise_plant  # pulls in scipy.linalg

        linear = linearise_plant(self, **point)
        return control_system(linear, (linear.A, linear.B, linear.C, linear.D, linear.dt or 0), "plant")

    def to_scipy(self, **point: Any) -> Any:
        """Return the plant about an operating point as a ``scipy.signal.StateSpace``, discrete where dt is
        given; ``point`` as for :meth:`to_control`.

        scipy names no signals: inputs are the plant's without its switches, then its disturbances, in order.
        """
        from scipy import signal

        from thermogrip.sysid.plant.linearise import linearise_plant

        linear = linearise_plant(self, **point)
        step = {} if linear.dt is None else {"dt": linear.dt}
        return signal.StateSpace(linear.A, linear.B, linear.C, linear.D, **step)

    def to_casadi(self, *, dt: float | None = None) -> Any:
        """Return one step of the plant as a CasADi ``Function`` (x, u, d, p) -> (x_next, y).

        y is what the sensors read at x, before the step.  The order within x, u, d, p and y is that of
        :func:`~thermogrip.sysid.plant.linearise.state_labels`, ``inputs`` (switches among them),
        ``disturbances``, ``model.parameters`` and ``outputs``; :attr:`p` are its parameters.

        Parameters
        ----------
        dt : float, optional
            Length of the step [s], a whole multiple of the plant's, which it is where absent.

        Raises
        ------
        UserError
            If dt is no multiple.

        Examples
        --------
        >>> from thermogrip.sysid.greybox.problem import prior_plant
        >>> from thermogrip.sysid.models.network import load_network
        >>> prior_plant(load_network("tclab")).to_casadi()
        Function(step:(x[4],u[2],d[0],p[11])->(x_next[4],y[2]) SXFunction)
        """
        import casadi as ca

        model, n = self.model, 1 if dt is None else whole_steps(dt, self.dt)
        sizes = (model.n_x, len(self.inputs), len(self.disturbances), len(model.parameters))
        symbols = [ca.SX.sym(name, size) for name, size in zip("xudp", sizes)]
        state, inputs, disturbances, parameters = (ca.vertsplit(v) if v.numel() else [] for v in symbols)
        y = model.output(state, parameters)
        for _ in range(n):
            state = model.step(state, inputs, disturbances, parameters, self.dt)
        return ca.Function("step", symbols, [ca.vertcat(*state), ca.vertcat(*y)], [*"xudp"], ["x_next", "y"])


def _load_model(content: Mapping[str, Any], *, code: Model | None = None) -> Model:
    """Return the model that ``Model.to_dict`` wrote, by its ``kind``; ``code`` is the class of a user's own
    model, which is in no file."""
    kind = content.get("kind") if isinstance(content, Mapping) else None
    if kind not in _MODELS:
        raise UserError(f"model of kind {kind!r} is unknown", hint=known_names(kind, _MODELS))
    if code is not None and (kind != code.kind or not hasattr(code, "restored")):
        raise UserError(f"its model ({kind}) needs no class", hint="leave the class out")
    module, name = _MODELS[kind]
    reader: Any = getattr(import_module(f"thermogrip.sysid.models.{module}"), name) if code is None else code
    model: Model = reader.from_dict(content) if code is None else reader.restored(content)
    return model
