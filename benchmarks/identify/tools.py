"""The peers: each fitted as its own documentation shows, behind one small face.

Data are scaled to mean 0 and standard deviation 1 over the training rows.  A linear state-space model starts
from a Kalman filter over the first rows; a regression starts from those rows themselves.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from rules import HEAD, Array, Peer, Record, Simulator
from scipy.signal import dlsim

__all__ = ["PEERS"]


class Scaled:
    """A record in standard deviations, and the way back."""

    def __init__(self, record: Record) -> None:
        self.u0, self.us = record.u.mean(axis=0), np.maximum(record.u.std(axis=0), 1e-9)
        self.y0, self.ys = record.y.mean(axis=0), np.maximum(record.y.std(axis=0), 1e-9)
        self.u, self.y, self.dt = (record.u - self.u0) / self.us, (record.y - self.y0) / self.ys, record.dt

    def simulator(self, run: Callable[[Array, Array], Array]) -> Simulator:
        """Wrap a simulator of scaled data."""
        return lambda u, head: run((u - self.u0) / self.us, (head - self.y0) / self.ys) * self.ys + self.y0


def _linear(matrices: Sequence[Array], noise: Sequence[Array]) -> Callable[[Array, Array], Array]:
    """Return a free run of x+ = A x + B u + w, y = C x + D u + v after a Kalman filter over the first rows.

    ``noise`` is the tool's own estimate: the covariances Q of w, R of v, and S between them.
    """
    A, B, C, D = (np.asarray(m, dtype=float) for m in matrices)
    Q, R, S = (np.asarray(m, dtype=float) for m in noise)

    def run(u: Array, head: Array) -> Array:
        x, P = np.zeros(len(A)), 1e3 * np.eye(len(A))
        for t, seen in enumerate(head):
            gain = (A @ P @ C.T + S) @ np.linalg.pinv(C @ P @ C.T + R)
            x = A @ x + B @ u[t] + gain @ (seen - C @ x - D @ u[t])
            P = A @ P @ A.T + Q - gain @ (A @ P @ C.T + S).T
        out = np.full((len(u), len(C)), np.nan)
        out[len(head) :] = dlsim((A, B, C, D, 1.0), u[len(head) :], x0=x)[1].reshape(-1, len(C))
        return out

    return run


def _nfoursid(record: Record, structure: Any) -> Simulator:
    import pandas as pd
    from nfoursid.nfoursid import NFourSID

    scaled, (rows, order) = Scaled(record), structure
    names_u = [f"u{k}" for k in range(scaled.u.shape[1])]
    names_y = [f"y{k}" for k in range(scaled.y.shape[1])]
    frame = pd.DataFrame(np.hstack([scaled.u, scaled.y]), columns=names_u + names_y)
    tool = NFourSID(frame, output_columns=names_y, input_columns=names_u, num_block_rows=rows)
    tool.subspace_identification()
    model, noise = tool.system_identification(rank=order)
    n_y = scaled.y.shape[1]
    parts = noise[n_y:, n_y:], noise[:n_y, :n_y], noise[n_y:, :n_y]
    return scaled.simulator(_linear((model.a, model.b, model.c, model.d), parts))


def _sippy(method: str) -> Callable[[Record, Any], Simulator]:
    def fit(record: Record, order: Any) -> Simulator:
        from sippy_unipi import system_identification

        scaled = Scaled(record)
        model = system_identification(scaled.y, scaled.u, method, SS_fixed_order=order, SS_f=20, SS_p=20)
        matrices = model.A, model.B, model.C, model.D
        return scaled.simulator(_linear(matrices, (model.Q, model.R, model.S)))

    return fit


def _sysidentpy(record: Record, structure: Any) -> Simulator:
    from sysidentpy.basis_function import Polynomial
    from sysidentpy.model_structure_selection import FROLS
    from sysidentpy.parameter_estimation import LeastSquares

    scaled, (degree, lag) = Scaled(record), structure
    models = []
    for k in range(scaled.y.shape[1]):
        model = FROLS(
            order_selection=True,
            n_info_values=15,
            ylag=lag,
            xlag=[list(range(1, lag + 1))] * scaled.u.shape[1] if scaled.u.shape[1] > 1 else lag,
            info_criteria="bic",
            estimator=LeastSquares(),
            basis_function=Polynomial(degree=degree),
        )
        model.fit(X=scaled.u, y=scaled.y[:, [k]])
        models.append(model)

    def run(u: Array, head: Array) -> Array:
        begin = HEAD - lag
        out = np.full((len(u), len(models)), np.nan)
        for k, model in enumerate(models):
            first = model.max_lag
            out[begin:, [k]] = model.predict(X=u[begin:], y=head[begin : begin + first, [k]])
        return out

    return scaled.simulator(run)


def _pysindy(record: Record, structure: Any) -> Simulator:
    import pysindy as ps

    scaled, (degree, threshold) = Scaled(record), structure
    model = ps.SINDy(
        optimizer=ps.STLSQ(threshold=threshold, alpha=1e-3),
        feature_library=ps.PolynomialLibrary(degree=degree),
        differentiation_method=ps.SmoothedFiniteDifference(),
    )
    model.fit(scaled.y, t=scaled.dt, u=scaled.u)

    def run(u: Array, head: Array) -> Array:
        def rate(x: Array, held: Array) -> Array:
            return np.clip(np.asarray(model.predict(x[None], u=held[None]))[0], -1e3, 1e3)

        out, x, h = np.full((len(u), head.shape[1]), np.nan), head[-5:].mean(axis=0), scaled.dt
        for t in range(HEAD, len(u)):
            out[t] = x
            a = rate(x, u[t])
            b = rate(x + h / 2 * a, u[t])
            x = np.clip(x + h * b, -1e3, 1e3)
        return out

    return scaled.simulator(run)


def _jax(neural: bool) -> Callable[[Record, Any], Simulator]:
    def fit(record: Record, order: Any) -> Simulator:
        import jax

        jax.config.update("jax_enable_x64", True)
        from jax_sysid.models import LinearModel

        scaled = Scaled(record)
        n_u, n_y = scaled.u.shape[1], scaled.y.shape[1]
        linear = LinearModel(order, n_y, n_u)
        linear.loss(rho_x0=1e-3, rho_th=1e-4)
        linear.optimization(adam_epochs=300, lbfgs_epochs=1000, iprint=-1)
        linear.fit(scaled.y, scaled.u)
        model = _neural(linear, scaled, order) if neural else linear

        def run(u: Array, head: Array) -> Array:
            x0 = model.learn_x0(u[: len(head)], head, RTS_epochs=3, verbosity=False, LBFGS_refinement=True)
            return np.asarray(model.predict(x0, u)[0])

        return scaled.simulator(run)

    return fit


def _neural(linear: Any, scaled: Scaled, order: int, units: int = 8, starts: int = 3) -> Any:
    """Return the best of a few neural state-space models that begin at the linear one."""
    import jax.numpy as jnp
    from jax_sysid.models import Model

    def state_fcn(x: Any, u: Any, params: Any) -> Any:
        A, B, W2, W1, b1, _ = params
        return A @ x + B @ u + W2 @ jnp.tanh(W1 @ jnp.hstack((x, u)) + b1)

    def output_fcn(x: Any, u: Any, params: Any) -> Any:
        return params[5] @ x

    n_u, n_y = scaled.u.shape[1], scaled.y.shape[1]
    A, B, C, _ = linear.ssdata()
    best, least = None, np.inf
    for seed in range(starts):
        rng = np.random.default_rng(seed)
        model = Model(order, n_y, n_u, state_fcn=state_fcn, output_fcn=output_fcn)
        weights = [
            A,
            B,
            0.01 * rng.standard_normal((order, units)),
            0.5 * rng.standard_normal((units, order + n_u)),
            0.1 * rng.standard_normal(units),
            C,
        ]
        model.init(params=weights, x0=linear.x0)
        model.loss(rho_x0=1e-3, rho_th=1e-4)
        model.optimization(adam_epochs=500, lbfgs_epochs=2000, iprint=-1)
        model.fit(scaled.y, scaled.u)
        error = float(np.mean((np.asarray(model.predict(model.x0, scaled.u)[0]) - scaled.y) ** 2))
        if error < least:
            best, least = model, error
    return best


PEERS = (
    Peer("sippy_unipi N4SID", (1, 2, 3, 4, 6, 8), _sippy("N4SID")),
    Peer("sippy_unipi CVA", (1, 2, 3, 4, 6, 8), _sippy("CVA")),
    Peer("nfoursid PO-MOESP", tuple((r, n) for r in (10, 20, 40) for n in (1, 2, 3, 4, 6, 8)), _nfoursid),
    Peer("sysidentpy FROLS", tuple((d, lag) for d in (1, 2) for lag in (2, 4, 8)), _sysidentpy),
    Peer("pysindy continuous", tuple((d, s) for d in (1, 2, 3) for s in (0.0, 1e-3, 1e-2)), _pysindy),
    Peer("jax-sysid linear", (2, 3, 4), _jax(False)),
    Peer("jax-sysid neural", (3,), _jax(True)),
)
