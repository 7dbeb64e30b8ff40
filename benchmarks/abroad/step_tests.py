"""Step tests of a TCLab that were recorded from the step on: one identified from, two of other days scored.

    python benchmarks/abroad/step_tests.py FOLDER

FOLDER holds files of github jckantor/CBE30338, not part of this project:
``TCLab_notebooks/Step_Test_Data.csv`` with a row before its step to 50 %, ``fromShared/step01.csv`` (another
board, 50 %) and ``notebooks/TCLab/step_test_data.csv`` (100 %) without one; there the rest that ``identify``
asks for is written above the first row.  Printed: what is found, the error of a free run [K] and the share of
its readings inside the 90 % band.
"""

from __future__ import annotations

import argparse
import warnings
from pathlib import Path

import numpy as np
import pandas as pd

from thermogrip.datasets.errors import UserError
from thermogrip.datasets.log_files import read_log
from thermogrip.sysid import identify
from thermogrip.sysid.data.shipped_networks import in_columns
from thermogrip.sysid.models.network import NetworkModel
from thermogrip.sysid.models.network_spec import named_network
from thermogrip.sysid.validation.free_run import free_run

FIT = "TCLab_notebooks/Step_Test_Data.csv"
OTHERS = ("fromShared/step01.csv", "notebooks/TCLab/step_test_data.csv")
BEFORE = 60  # rows of rest before the logs that are scored, so that the state is known


def rested(path: Path) -> pd.DataFrame:
    """Return a step test with rest before its first row."""
    frame = pd.read_csv(path)[["Time", "Q1", "T1", "T2"]]
    rest = frame.iloc[[0] * BEFORE].assign(Q1=0.0, Time=frame.Time.iloc[0] - np.arange(BEFORE, 0, -1.0))
    return pd.concat([rest, frame])


def main() -> None:
    """Identify, run, print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    warnings.simplefilter("ignore")
    log = read_log(pd.read_csv(folder / FIT)[["Time", "Q1", "T1", "T2"]])
    for label, network in (
        ("default", None),
        ("tclab", in_columns(NetworkModel(named_network("tclab")), log)),
    ):
        models = {"models": ["network"]} if network is not None else {}
        try:
            found = identify(log, network, **models)
        except UserError as error:
            print(f"{label}: {error}")
            continue
        print(f"{label}: {found.model}; {found.verdict}")
        for name in OTHERS:
            run = free_run(found.plant, rested(folder / name), warmup=50, score_from=50, tests=False)
            band = run.band()
            for output, score in run.scores.items():
                print(f"  {name} {output}: {score.rmse:.2f} K, band holds {band.inside[output]:.2f}")


if __name__ == "__main__":
    main()
