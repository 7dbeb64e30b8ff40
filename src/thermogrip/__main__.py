"""``python -m thermogrip``."""

from thermogrip.cli import main

if __name__ == "__main__":
    raise SystemExit(main())
