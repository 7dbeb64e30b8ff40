"""In an install without extras: every module imports, verbs work, and an LSTM says what to install.

Runs in an empty folder, with the Python of such an install.
"""

import importlib
import pkgutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import thermogrip

EXTRAS = (
    "aeon",
    "control",
    "distributed",
    "foxglove",
    "mcap",
    "rosbags",
    "starlette",
    "torch",
    "uvicorn",
    "websockets",
)
GRASPS = "grasps/exp3C_obj18_grip38.csv.xz"
VERBS = (
    "init examples",
    "materials copper",
    "identify multisine.csv.xz --models arx --out plant.json",
    "validate plant.json pump_on_off.csv.xz",
    f"train {GRASPS} --classifier bayes --out model",
    f"classify model {GRASPS} --out said.csv",
    f"effusivity {GRASPS} --out posterior.csv",
    f"compare {GRASPS} --repeats 0 --out comparison",
    f"compare {GRASPS} --classifiers bayes,lstm --repeats 0 --out others",  # which leaves the LSTM out
)
REFUSED = (
    f"train {GRASPS} --classifier lstm --out lstm",
    f"compare {GRASPS} --classifiers lstm --out lstm",
    "paper --out paper",
)
HINT = 'thermogrip: lstm is trained with torch, which is not installed; pip install "thermogrip[lstm]"\n'


def run(line: str) -> subprocess.CompletedProcess[str]:
    """Run one command line of thermogrip."""
    program = Path(sys.executable).with_name("thermogrip")
    return subprocess.run([program, *line.split()], capture_output=True, text=True, check=False)


def main() -> int:
    """Return the number of things that are not as they should be."""
    wrong = [f"{name} is installed" for name in EXTRAS if find_spec(name)]
    modules = [found.name for found in pkgutil.walk_packages(thermogrip.__path__, "thermogrip.")]
    for name in modules:
        if not name.endswith("__main__"):
            try:
                importlib.import_module(name)
            except ImportError as error:
                wrong.append(f"{name}: {error}")
    for line in VERBS:
        done = run(line)
        if done.returncode not in (0, 3):  # 3: done, but the answer is no
            wrong.append(f"{line}: {done.returncode}, {done.stderr}")
    for line in REFUSED:
        done = run(line)
        if (done.returncode, done.stderr) != (2, HINT):
            wrong.append(f"{line}: {done.returncode}, {done.stderr}")
    sys.stdout.write("".join(f"{line}\n" for line in wrong))
    sys.stdout.write(f"{len(modules)} modules, {len(VERBS) + len(REFUSED)} commands, {len(wrong)} wrong\n")
    return len(wrong)


if __name__ == "__main__":
    raise SystemExit(main())
