"""TCLabs of three public collections: a plant of one log, or of three, scored on the logs of other days.

    python benchmarks/abroad/other_days.py FOLDER

FOLDER/tclabsp holds ``r01.csv`` ... of github TiagoPrata/TCLabSP (``ens_IdentificationH1H2_Random_*.mat``,
``timeseries`` that ``mat-io`` reads, averaged over 2 s), FOLDER/fnr13 ``train.csv`` and ``test.csv`` of
FNR13/TCLab-Predictive-Control (``openloop_data_*.mat``), FOLDER/heeejini ``e1.csv`` ... of heeejini/TCLab
(``mpc_episode_*_data.csv``); columns are ``time_s``, ``q1_percent``, ``q2_percent``, ``t1_degC`` and
``t2_degC``.  They are not part of this project.  Printed by log: the error of the free run over what was
stated, the share of readings in the 90 % band, the verdict of ``validate``, whether one gain is most of it,
and whether by its correlations or the error of the fit alone the plant would be called another one.
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Callable
from pathlib import Path

from thermogrip.datasets.log_files import read_log
from thermogrip.sysid import identify
from thermogrip.sysid.validation.free_run import free_run

# folder, logs of the fit, whether the network alone, which others are scored
CASES: list[tuple[str, tuple[str, ...], str, Callable[[str], bool]]] = [
    ("tclabsp", ("r01",), "default", lambda name: int(name[1:]) % 2 == 0),
    ("tclabsp", ("r01",), "network", lambda name: int(name[1:]) % 2 == 0),
    ("fnr13", ("train",), "black boxes", lambda name: True),
    ("fnr13", ("train",), "network", lambda name: True),
    ("heeejini", ("e1",), "default", lambda name: True),
    ("heeejini", ("e48",), "black boxes", lambda name: True),
    ("heeejini", ("e1", "e44", "e50"), "default", lambda name: True),
]


def main() -> None:
    """Print a line for each plant, and one for each other log that is scored."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    given = parser.parse_args()
    for folder, fitted, kind, scored in CASES:
        files = sorted((given.folder / folder).glob("*.csv"))
        if not files:
            print(f"{folder}: no files")
            continue
        train = [read_log(given.folder / folder / f"{name}.csv") for name in fitted]
        how = {"network": ["network"], "black boxes": ["arx", "oe", "subspace", "sindy", "neural"]}.get(kind)
        network = None if kind == "black boxes" else "tclab"
        found = identify(train, network) if how is None else identify(train, network, models=how)
        print(f"{folder}, {'+'.join(fitted)}, {kind}: {found.model}, {'good' if found.good else 'not good'}")
        for file in files:
            if file.stem in fitted or not scored(file.stem):
                continue
            run = free_run(found.plant, read_log(file))
            band, said = run.band(), " ".join(run.notes)
            errors = "; ".join(
                f"{name} {score.rmse / band.expected[name]:.2f}, {band.inside[name]:.2f}"
                for name, score in run.scores.items()
            )
            assert run.verdict is not None
            named = any(t.significant for row in run.residual.tests.values() for t in row.values())
            alone = " by tests alone" if named or run.exceeds_fit or run.no_better else ""
            gain = " one gain" if "most of the error is one gain" in said else ""
            print(f"  {file.stem}: {errors} {run.verdict.standing}{gain}{alone}", flush=True)


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    main()
