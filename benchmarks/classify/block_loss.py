"""Does a block go to the room's temperature while it is held?  And does the skin?

The engine's block loses heat to the gripper alone.  What else it might do adds c x to the readings of a
grasp, x a known shape; with everything fitted at c = 0 (theta of the joint calibration, nuisances w of every
grasp) c and its gain in -2 ln evidence follow from the normal equations bordered by x.  The shapes, with F
the response and S its integral since contact:

- the block goes to the room at a rate c [1/s]: (T_room - T_obj) S, since the skin answers to it by F;
- the block holds back the skin's own drift: -(T_room - b) (S + (1 + t0) F), c the leak;
- metals and wood leak at different rates;
- an own drift of each grasp, held back by its block: in place of c its spread [K/s], by maximum likelihood.

On training grasps alone::

    OMP_NUM_THREADS=1 python benchmarks/classify/block_loss.py
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import minimize_scalar

from thermogrip.datasets.examples import load_example_grasps
from thermogrip.sysid.effusivity import calibration
from thermogrip.sysid.effusivity.calibration import linearise
from thermogrip.sysid.effusivity.data import whiten
from thermogrip.sysid.effusivity.gripper_model import NOTHING
from thermogrip.sysid.effusivity.laplace_approximation import LEVEL, ONSET, T_OBJECT
from thermogrip.sysid.effusivity.posterior import material_evidence


def fitted():
    """Return the calibration on the bundled training grasps, and problem, last step, w, spreads and noise."""
    seen, fit = [], calibration._fit

    def spy(problem, theta, w, spread, noise, progress, **how):
        step, w, spread = fit(problem, theta, w, spread, noise, progress, **how)
        seen.append((problem, step.theta, w, spread, noise))
        return step, w, spread

    calibration._fit = spy
    try:
        device = calibration.calibrate_example_gripper()
    finally:
        calibration._fit = fit
    return device, seen[-1]


def evidence(device):
    """Return -2 ln evidence of the training grasps as what they are, by file."""
    out = {}
    for name, record in load_example_grasps().items():
        if name[:4] in ("exp1", "exp2", "exp3", "exp4"):
            train = record.isel(grasp=record["split"].values == "train")
            names = sorted(set(train["material"].values.tolist()))
            own = [names.index(m) for m in train["material"].values]
            out[name] = -2 * material_evidence(device, train, names)[np.arange(len(own)), own].sum()
    return out


class Bordered:
    """The normal equations of theta and w at the fit, to be bordered by shapes."""

    def __init__(self, problem, theta, w, spread, noise):
        self.problem, self.theta, self.data = problem, theta, problem.data
        self.scale = problem.scales(spread)
        self.u = problem.centre(theta) + self.scale * w
        self.whitener = whiten(problem.data, noise)[0]
        lin = linearise(problem, theta, w, spread)
        self.left = np.einsum("nij,nj->ni", self.whitener, problem.data.y - lin.y)
        self.j, self.k = self.whitener @ lin.by_w, self.whitener @ lin.by_theta
        # the temperature of the object enters with the response itself
        self.f = lin.by_w[:, :, T_OBJECT] / self.scale[:, T_OBJECT, None]
        self.slope_w = np.einsum("nik,ni->nk", self.j, self.left) - w
        self.inverse = np.linalg.inv(np.eye(w.shape[1]) + self.j.transpose(0, 2, 1) @ self.j)

    def total(self):
        """Return the integral of each response since contact, by trapezes over the bins (n, n_bin) [s]."""
        out = np.zeros_like(self.f)
        for i, (t, f) in enumerate(zip(self.data.t, self.f)):
            order = np.argsort(t)
            steps = np.diff(t[order]) * 0.5 * (f[order][1:] + f[order][:-1])
            out[i, order] = np.concatenate([[0.0], np.cumsum(steps)])
        return out

    def solve(self, shapes):
        """Return gain, coefficients, their sds, and by how much each T_obj moves [K]."""
        there, n = self.data.count > 0, self.theta.size
        k = np.concatenate([self.k, *((self.whitener @ (x * there)[:, :, None]) for x in shapes)], axis=2)
        prior, border = np.zeros((k.shape[2],) * 2), self.j.transpose(0, 2, 1) @ k
        prior[:n, :n] = self.problem.prior.precision
        part = border.transpose(0, 2, 1) @ self.inverse
        matrix = prior + np.einsum("nia,nib->ab", k, k) - (part @ border).sum(axis=0)
        slope = np.einsum("nik,ni->k", k, self.left) - np.einsum("nka,na->k", part, self.slope_w)
        slope[:n] -= self.problem.prior.precision @ (self.theta - self.problem.prior.mean)
        covariance = np.linalg.inv(matrix)
        move = covariance @ slope
        w = np.einsum("nab,nb->na", self.inverse, self.slope_w - border @ move)
        moved = w[:, T_OBJECT] * self.scale[:, T_OBJECT]
        centre = self.problem.centre(self.theta + move[:n]) - self.problem.centre(self.theta)
        own = slice(n, None)
        return slope @ move, move[own], np.sqrt(np.diag(covariance))[own], moved + centre[:, T_OBJECT]

    def spread(self, x):
        """Return the likeliest spread of a shape's size from grasp to grasp, and its gain."""
        x = np.einsum("nij,nj->ni", self.whitener, x * (self.data.count > 0))
        jx = np.einsum("nik,ni->nk", self.j, x)
        news = np.einsum("ni,ni->n", x, self.left) - np.einsum("na,nab,nb->n", jx, self.inverse, self.slope_w)
        information = (x**2).sum(axis=1) - np.einsum("na,nab,nb->n", jx, self.inverse, jx)

        def cost(ln_sd):
            v = np.exp(2 * ln_sd)
            return float((np.log1p(v * information) - news**2 * v / (1 + v * information)).sum())

        best = minimize_scalar(cost, bounds=(-14.0, 0.0), method="bounded")
        return np.exp(best.x), -best.fun, cost(np.log(0.01))


def main():
    with_loss = fitted()
    wide = calibration._WIDE["ln_g_far"]
    calibration._WIDE["ln_g_far"] = (np.log(NOTHING), 1e-3)
    without = fitted()
    calibration._WIDE["ln_g_far"] = wide
    device, bare = with_loss[0], without[0]
    at = device.uncertainty.names.index("ln_g_far")
    sd = np.sqrt(device.uncertainty.covariance[at, at])
    print(f"the far face loses {device.stack.g_far:.0f} W/m2K, +- {sd:.2f} in the logarithm")
    now, then = evidence(device), evidence(bare)
    for name in now:
        print(f"{name}: {now[name] - then[name]:+.1f}")
    print(f"-2 ln evidence of all {sum(now.values()) - sum(then.values()):+.1f}")
    for what, one in (("without", bare), ("with", device)):
        ratio = {n: np.exp(b.ln_effusivity) / b.library_effusivity for n, b in one.blocks.items()}
        said = ", ".join(f"{name} {value:.3f}" for name, value in ratio.items())
        print(f"{what}: effusivity over the library's {said}; depth over 20 mm {one.depth_share:.3f}")
    for what, (_, state) in (("without", without), ("with", with_loss)):
        print(f"\n{what} the far face")
        borders(Bordered(*state))


def borders(at):
    """Print what each shape would bring."""
    data, u, total = at.data, at.u, at.total()
    level, onset = u[:, LEVEL, None], u[:, ONSET, None]
    to_room, wood = data.t_ambient[:, None] - level, (data.material == "wood")[:, None]
    of_block = (data.t_ambient[:, None] - u[:, T_OBJECT, None]) * total
    held = -to_room * (total + (1 + onset) * at.f)
    base = at.solve([])[0]
    for what, shapes in (
        ("block to the room [1/s]", [of_block]),
        ("block holds the skin's drift back [1/s]", [held]),
        ("both [1/s]", [of_block, held]),
        ("wood leaks otherwise [1/s]", [to_room * data.ramp * wood]),
    ):
        gain, c, sd, moved = at.solve(shapes)
        said = ", ".join(f"{a:+.5f} +- {b:.5f}" for a, b in zip(c, sd))
        print(f"{what}: {said}, -2 ln Z {base - gain:+.1f}")
        if len(shapes) == 1 and what.startswith("block to"):
            for nominal in (18.0, 28.0, 43.0):
                there = (data.t_object == nominal) & ~wood[:, 0]
                print(f"    metals at {nominal:g} degC are found {moved[there].mean():+.2f} K warmer")
    sd, gain, at_most = at.spread(np.maximum(data.t + 1, 0.0) - total - (1 + onset) * at.f)
    print(f"own drift of each grasp: sd {sd:.4f} K/s, -2 ln L {-gain:+.1f}; {at_most:+.0f} at 0.01 K/s")


if __name__ == "__main__":
    main()
