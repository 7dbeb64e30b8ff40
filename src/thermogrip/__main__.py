"""The door of the program, ``thermogrip`` and ``python -m thermogrip``."""

import os
import signal
import sys
import warnings
from types import FrameType


def main() -> int:
    """Run the words of the process and return the exit code."""
    usual = signal.getsignal(signal.SIGINT) is signal.default_int_handler  # nohup and its like ignore it
    if usual:
        # while the command line is imported a Ctrl-C ends the process at once: nothing was begun, and Python
        # loses an exception that a signal raises in a callback of an import
        signal.signal(signal.SIGINT, _leave)
    if not sys.warnoptions and "--debug" not in sys.argv:  # they name lines of code, not what to do
        warnings.simplefilter("ignore")
    from thermogrip.cli.main import main as run

    if usual:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        code = run()
    except KeyboardInterrupt:  # a second one, while the line of the first was written
        code = 130
    if usual and code == 130:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # nothing is left to do but to go
    return code


def _leave(number: int, frame: FrameType | None) -> None:
    """Say one line and end the process."""
    sys.stderr.write("thermogrip: stopped by Ctrl-C\n")
    sys.stderr.flush()
    os._exit(130)


if __name__ == "__main__":
    raise SystemExit(main())
