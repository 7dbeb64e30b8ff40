"""Aluminium, wood and cooled wood under one and two sensors, the objects' temperatures unknown.

    python benchmarks/classify/ambiguous.py FOLDER [--train 1-20] [--test 21-30] [--within] \
        [--cases heated,both] [--classifiers A,B] [--out F.json] [--own-bound N]

The contacts of ``two_sensors.py`` with all 30 sets: FOLDER is ``robot_study/test`` as published.  The
question is the material; cooled wood is wood.  Training: the room was 22.7 degC, where aluminium and wood
lay; of cooled wood no temperature is given.  Test: nothing but the room is known.
``--within``: five folds of whole sets within the test sets, in place of the training sets.
``--own-bound N``: instead, N times as many contacts of cooled wood as the test sets have, drawn from the
posterior's own calibrated model (spreads, noise, discrepancy), and the errors of the temperatures that it
then finds: what it would err by if it were true.

Effusivities of 24050 and 367 count as true (the table's aluminium and wood), and 13.7 degC for cooled wood,
which nobody measured.  What was chosen for the posterior (the widths of a discrepancy, how much evidence
counts) was chosen on sets 1 to 20, whole sets held out.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
from two_sensors import read

from thermogrip.classify import make_classifier
from thermogrip.classify.estimators.lda import ArrayClassifier
from thermogrip.classify.evaluation.metrics import calibration_bins, log_loss
from thermogrip.datasets.schema import Grasps
from thermogrip.sysid.effusivity import effusivity_posterior
from thermogrip.sysid.effusivity.data import noise_covariance, touches
from thermogrip.sysid.effusivity.laplace_approximation import (
    EFFUSIVITY,
    LEVEL,
    T_OBJECT,
    Hypotheses,
    material_hypotheses,
    nodes_for,
    predict,
    prior_of,
)
from thermogrip.sysid.effusivity.posterior_grid import grid_posteriors, mixture_quantiles

ROOM, COLD = 22.7, 13.7
E_TRUE = {"aluminium": 24050.0, "wood": 367.2, "wood_cold": 367.2}
T_TRUE = {"aluminium": ROOM, "wood": ROOM, "wood_cold": COLD}
PEERS = "svm-pca,pca-lda,sklearn.ensemble:RandomForestClassifier,logistic-pca,rocket"


def contacts(folder: Path, sets: set[int], *, both: bool, known: bool) -> tuple[Grasps, np.ndarray]:
    """Return the contacts of some sets under the names of materials, and which of the three each is."""
    every = read(folder)
    own = every.isel(grasp=[int(str(s)[3:]) in sets for s in every["session"].values])
    which = own["material"].values.astype(str)
    lay = np.where((which != "wood_cold") & known, ROOM, np.nan)
    own = own.assign(
        material=("grasp", np.where(which == "aluminium", "aluminium", "wood")), t_object=("grasp", lay),
        t_ambient=("grasp", np.full(which.size, ROOM)),
    )  # fmt: skip
    return own if both else own.drop_vars("t_surface_2"), which


class Traces(ArrayClassifier):
    """Logistic regression on ten principal components of the traces (``"logistic-pca"``)."""

    def __init__(self) -> None:
        from sklearn.decomposition import PCA
        from sklearn.linear_model import LogisticRegression
        from sklearn.pipeline import make_pipeline
        from sklearn.preprocessing import StandardScaler

        model = make_pipeline(PCA(10), StandardScaler(), LogisticRegression(max_iter=5000))
        super().__init__(model, start=-np.inf, subtract_level=False, standardise=False)


def numbers(text: str) -> list[int]:
    """Return the sets of "1-20"."""
    low, high = text.split("-")
    return list(range(int(low), int(high) + 1))


def error(p: np.ndarray, right: np.ndarray) -> float:
    """Return the expected calibration error of probabilities (n, 2)."""
    bins = calibration_bins(p.max(axis=1), right)
    return sum(b.n * abs(b.confidence - b.accuracy) for b in bins) / right.size


def main() -> None:
    """Evaluate, print, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--train", default="1-20")
    parser.add_argument("--test", default="21-30")
    parser.add_argument("--within", action="store_true")
    parser.add_argument("--cases", default="heated,both")
    parser.add_argument("--classifiers", default=f"posterior,{PEERS}")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--own-bound", type=int)
    given = parser.parse_args()
    test, train = numbers(given.test), numbers(given.train)
    if given.own_bound:
        own_bound(given.folder, set(train), set(test), given.own_bound)
        return
    folds = [(set(train), set(test))]
    if given.within:
        folds = [(set(test) - set(test[k::5]), set(test[k::5])) for k in range(5)]
    rows = []
    for case in given.cases.split(","):
        for name in given.classifiers.split(","):
            row = {"case": case, "classifier": name, **score(given.folder, name, case == "both", folds)}
            rows.append(row)
            print(
                "  ".join(f"{k} {v:.3f}" if isinstance(v, float) else str(v) for k, v in row.items()),
                flush=True,
            )
    if given.out:
        given.out.write_text(json.dumps(rows), encoding="utf-8")


def own_bound(folder: Path, train: set[int], test: set[int], n: int) -> None:
    """Print how far off temperatures of cooled wood are where the calibrated model is the truth."""
    learnt, _ = contacts(folder, train, both=False, known=True)
    device = make_classifier("posterior", seed=0).fit(learnt).device_
    asked, which = contacts(folder, test, both=False, known=False)
    data = touches(asked.isel(grasp=np.flatnonzero(which == "wood_cold")))
    wood = material_hypotheses(device, ["wood"])
    law = prior_of(device, data, Hypotheses(*(np.repeat(h, data.level.size) for h in wood)))
    beyond = device.beyond(data.t, law.mean[:, EFFUSIVITY])
    root, rng = np.linalg.cholesky(noise_covariance(data, device.noise)), np.random.default_rng(0)
    medians, every = [], []
    for _ in range(n):
        u = law.mean + law.sd * rng.standard_t(np.minimum(law.dof, 1e6))
        u[:, T_OBJECT], u[:, LEVEL] = COLD, data.level
        noise = np.einsum("nij,nj->ni", root, rng.standard_normal(data.y.shape))
        y = np.where(data.count > 0, predict(device.stack, nodes_for(data), data, u, beyond) + noise, data.y)
        found = grid_posteriors(device, replace(data, y=y))
        t = [mixture_quantiles(p.weight, p.t_object, p.t_object_sd, (0.05, 0.5, 0.95)) for p in found]
        medians.append(float(np.median(np.abs(np.array(t)[:, 1] - COLD))))
        every += t
    low, middle, high = np.array(every).T
    print(
        f"{middle.size} contacts of cooled wood by the model itself: |T - true| "
        f"{np.median(np.abs(middle - COLD)):.1f} K in the median, {data.level.size} at a time "
        f"{min(medians):.1f} to {max(medians):.1f}, at most 5 in {np.mean(np.array(medians) <= 5):.2f}; "
        f"intervals hold {np.mean((low <= COLD) & (high >= COLD)):.2f}"
    )


def score(folder: Path, name: str, both: bool, folds: list[tuple[set[int], set[int]]]) -> dict[str, float]:
    """Return what one classifier has over all folds."""
    answers, kinds, effusivities = [], [], []
    for train, test in folds:
        learnt, _ = contacts(folder, train, both=both, known=True)
        asked, which = contacts(folder, test, both=both, known=False)
        model = (Traces() if name == "logistic-pca" else make_classifier(name, seed=0)).fit(learnt)
        assert list(model.classes_) == ["aluminium", "wood"]
        answers.append(model.predict_proba(asked))
        kinds.append(which)
        if name == "posterior":
            found = effusivity_posterior(model.device_, asked)
            effusivities += [
                (r.effusivity_p05, r.effusivity_p95, r.t_object_p05, r.t_object, r.t_object_p95)
                for r in found
            ]
    p, which = np.concatenate(answers), np.concatenate(kinds)
    true = (which != "aluminium").astype(int)
    right = p.argmax(axis=1) == true
    out = {
        "n": str(right.size), "right": str(int(right.sum())), "accuracy": float(right.mean()),
        "log_loss": float(np.mean(log_loss(p, true))), "ece": float(error(p, right)),
    }  # fmt: skip
    for kind in E_TRUE if effusivities else ():
        low, high, t_low, t, t_high = np.array(effusivities)[which == kind].T
        out[f"{kind} e holds"] = float(np.mean((low <= E_TRUE[kind]) & (E_TRUE[kind] <= high)))
        out[f"{kind} T"] = float(np.median(t))
        out[f"{kind} |T - true|"] = float(np.median(np.abs(t - T_TRUE[kind])))
        out[f"{kind} T holds"] = float(np.mean((t_low <= T_TRUE[kind]) & (T_TRUE[kind] <= t_high)))
    return out


if __name__ == "__main__":
    main()
