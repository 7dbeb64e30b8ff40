"""On a system without POSIX terminals and locks: everything imports, sockets and twins work, ptys refuse.

Windows has no ``termios``, ``pty``, ``tty`` or ``fcntl``, nor SIGKILL, nor O_CLOEXEC.  A process that cannot
find them takes its place; what Windows does otherwise in what it has, this does not show.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

LACKING = """
import os, signal, sys
import subprocess, shutil, tempfile, serial, serial.urlhandler.protocol_socket  # know Windows themselves

LACKING = {"termios", "pty", "tty", "fcntl", "resource", "pwd", "grp"}

class Without:
    def __init__(self, finder):
        self.finder = finder
    def __getattr__(self, name):
        return getattr(self.finder, name)
    def find_spec(self, name, path=None, target=None):
        return None if name in LACKING else self.finder.find_spec(name, path, target)

for name in LACKING:
    sys.modules.pop(name, None)
sys.meta_path[:] = [Without(finder) for finder in sys.meta_path]
for name in ("SIGKILL", "SIGHUP", "SIGSTOP", "SIGCONT"):
    delattr(signal, name)
for name in ("openpty", "ttyname", "fchmod", "pread", "pwrite", "O_CLOEXEC", "O_NOFOLLOW", "getuid", "fork"):
    delattr(os, name)
"""

IMPORTS = """
from importlib import import_module
from pathlib import Path
for room in ("rig", "datasets"):
    for path in sorted(Path(sys.argv[1], room).rglob("*.py")):
        parts = path.relative_to(sys.argv[1]).with_suffix("").parts
        import_module(".".join(["thermogrip", *(part for part in parts if part != "__init__")]))
from thermogrip.cli.main import main
print("imported", main(["virtual", "--pty", "--seconds", "0"]))
"""

SOCKET = """
import json
from tests.rig.makers import SteppedClock
from thermogrip.datasets.errors import UserError
from thermogrip.rig.drivers.connect import open_rig
from thermogrip.rig.session.session import play
from thermogrip.rig.records.run_folder import RunFolder
from thermogrip.rig.records.run_folder import read_run
from thermogrip.rig.simulation.virtual_device import VirtualDevice
from thermogrip.datasets.schema import make_log
from thermogrip.sysid.plant.plant import Plant
from thermogrip.sysid.models.state_space import StateSpaceModel

block = StateSpaceModel(("drive",), (), ("t_tank",), A=[[0.99]], B=[[0.5]], C=[[1.0]], dt=1.0, y0=[25.0])
plant = Plant(block, {}, dt=1.0, units={"drive": "1", "t_tank": "degC"})
try:
    VirtualDevice(plant, link="pty")
except UserError as error:
    print(error)
clock = SteppedClock()
with VirtualDevice(plant, link="socket", clock=clock) as device:
    rig = open_rig(device.port, clock=clock, sleep=clock.sleep)
    schedule = make_log([0.0, 1.0, 2.0, 3.0], {"drive": ([0.0, 0.2, 0.2, 0.0], "1", "input")}, name="s")
    with RunFolder(sys.argv[2], {}) as folder:
        log, ended = play(rig, schedule, dt=1.0, clock=clock, recorder=folder)
    rig.close()
run = read_run(sys.argv[2])
print(ended or "played", run.log.sizes["time"] == log.sizes["time"], run.lost)
"""

ROOT = Path(__file__).parents[2]
NO_PTY = "this system has no pseudo-terminals; serve a socket: --socket PORT, or link='socket'"


def test_modules_import_and_a_socket_serves_without_posix_terminals_and_locks(tmp_path: Path) -> None:
    words = [sys.executable, "-c", LACKING + IMPORTS + SOCKET, str(ROOT), str(tmp_path / "run")]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stderr == f"thermogrip: {NO_PTY}\n"  # of the verb
    assert done.stdout.splitlines() == ["imported 2", NO_PTY, "played True ()"]
    assert b"\r" not in (tmp_path / "run" / "samples.csv").read_bytes()
